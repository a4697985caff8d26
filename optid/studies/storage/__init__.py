"""Rows: what they hold, the database and the journal that outlives a kill."""
