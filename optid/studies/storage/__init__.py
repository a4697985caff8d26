"""Rows: their columns, the SQLite database that holds them, and exports."""
