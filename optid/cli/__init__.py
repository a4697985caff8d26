"""The command line."""

from optid.cli.app import app

__all__ = ["app"]
