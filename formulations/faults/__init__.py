"""Fault formulations."""
