"""Solve programmes and procedures with any back end."""
