"""One line for a call that must be refused with words about what is wrong."""

from collections.abc import Callable
from typing import Any

import pytest

from optid.errors import DataError


def refuses(error: type[Exception], words: str, function: Callable[..., Any], *arguments: Any, **settings: Any) -> None:
    """Assert that a call raises this error, with a message that matches the words, a regular expression."""
    with pytest.raises(error, match=words):
        function(*arguments, **settings)


def refused(words: str, function: Callable[..., Any], *arguments: Any, error: type[Exception] = DataError,
            **settings: Any) -> None:
    """As `refuses`, of records."""
    refuses(error, words, function, *arguments, **settings)
