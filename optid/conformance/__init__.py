"""Conformance of back ends and formulations."""
