"""Complete failures by rank deficiency (chapter 7)."""
