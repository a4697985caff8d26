"""Calls that must be refused."""

import pytest


def refuses(error, words, function, *args, **options):
    """The call raises this error, and its message matches these words."""
    with pytest.raises(error, match=words):
        function(*args, **options)
