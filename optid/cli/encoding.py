"""Readable substitutes for characters that the encoding of the output lacks, such as cp1252 on Windows."""

import codecs
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper

NAME = "optid-readable"  # of the error handler
SUBSTITUTES = {"‖": "|", "ᵀ": "^T", "²": "^2", "³": "^3", "⁻": "^-", "·": "*", "×": "x", "÷": "/", "−": "-",
               "±": "+/-", "µ": "u",
               "≤": "<=", "≥": ">=", "≈": "~", "≠": "!=", "→": "->", "←": "<-", "∞": "inf", "√": "sqrt", "°": "deg ",
               "–": "-", "—": "-", "…": "...", "•": "*", "‘": "'", "’": "'", "“": '"', "”": '"', "⁄": "/", "═": "=",
               "│": "|", "┃": "|", "║": "|", "ß": "ss", "æ": "ae"}


def substitute(character: str) -> str:
    """Return a readable text in ASCII for a character; "?" where there is none."""
    if character in SUBSTITUTES:
        return SUBSTITUTES[character]
    kind, _, rest = unicodedata.name(character, "").partition(" ")
    if kind in ("GREEK", "LATIN") and (letter := rest.partition("LETTER ")[2].partition(" ")[0]):
        return letter.capitalize() if rest.startswith("CAPITAL") else letter.lower()
    if kind == "BOX":
        return "-" if "HORIZONTAL" in rest and "VERTICAL" not in rest else "+"
    if unicodedata.combining(character):
        return ""
    parts = unicodedata.normalize("NFKD", character)
    return "?" if parts == character else "".join(c if c.isascii() else substitute(c) for c in parts)


@contextmanager
def readable_output() -> Iterator[None]:
    """Write substitutes for what the encodings of standard output and error lack, instead of failing."""
    streams = [stream for stream in (sys.stdout, sys.stderr) if isinstance(stream, TextIOWrapper)]
    before = [stream.errors for stream in streams]
    for stream in streams:
        stream.reconfigure(errors=NAME)
    try:
        yield
    finally:
        for stream, errors in zip(streams, before):
            if not stream.closed:
                stream.reconfigure(errors=errors)


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(substitute, error.object[error.start : error.end])), error.end


codecs.register_error(NAME, _replace)
