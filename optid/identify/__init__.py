"""Identification: fit, order, validation, uncertainty, experiment design."""

import sys
from types import ModuleType
from typing import Any


class _Verb(ModuleType):
    """This package, which is also the function `optid.identify`: both have one name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        from optid.identify.search import identify

        return identify(*args, **kwargs)


sys.modules[__name__].__class__ = _Verb
