"""One line for a call that must be refused with words about what is wrong."""

from collections.abc import Callable
from typing import Any

import pytest

from optid.errors import DataError


def refused(words: str, function: Callable[..., Any], *arguments: Any, error: type[Exception] = DataError,
            **settings: Any) -> None:
    """Assert that a call raises an error whose message matches the words, a regular expression."""
    with pytest.raises(error, match=words):
        function(*arguments, **settings)
