"""Results for people: printed text, tables, figures and pages."""
