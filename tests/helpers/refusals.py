"""One line for a call that must be refused with words about what is wrong."""

from collections.abc import Callable
from typing import Any

import pytest

Errors = type[Exception] | tuple[type[Exception], ...]


def refuses(error: Errors, words: str, function: Callable[..., Any], *arguments: Any, **settings: Any) -> None:
    """Assert that a call raises this error, with a message that matches the words, a regular expression."""
    with pytest.raises(error, match=words):
        function(*arguments, **settings)
