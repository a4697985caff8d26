"""Tests that ask whether a hypothesis can be true at all: any course, more noise, bounded noise, what is left."""
