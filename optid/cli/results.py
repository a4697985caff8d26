"""What a command leaves behind: pictures, the printed result, its notes, and what was written where."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from optid.cli.terminal import coloured, note, say
from optid.errors import DataError


def command_line() -> str:
    """Return the words of this run, as a page says them."""
    return shlex.join(["optid", *sys.argv[1:]])


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure of matplotlib.

    Raises:
        DataError: an ending that matplotlib does not know.
    """
    try:
        figure.savefig(path, dpi=150)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None


def conclude(text: str, heard: Sequence[str], **written: Path | None) -> None:
    """Print a result, then the notes it does not carry itself, then what was written where.

    Args:
        text: the result.
        heard: sentences that `hearing` has collected.
        written: files by what they hold, e.g. ``report=path``; None for those that were not asked for.
    """
    say(coloured(text))
    said = " ".join(text.split())
    for sentence in heard:
        if " ".join(sentence.split()) not in said:
            note(sentence)
    for what, path in written.items():
        if path is not None:
            say(f"{what} written to {path}")
