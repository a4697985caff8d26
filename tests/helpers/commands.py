"""Commands as on a terminal, inside the process of the tests."""

from typing import Any

from typer.testing import CliRunner

from optid.cli.app import app


def run(*words: object) -> Any:
    """Run the command of these words and return its exit code and output."""
    return CliRunner().invoke(app, [str(word) for word in words])
