"""Tests whether a hypothesis is possible at all: any course, more noise, bounded noise, the residual of an answer."""
