"""Back ends: the only modules that call solvers."""

from optid.backends.back_end import Answer, BackEnd, Settings
from optid.backends.choice import back_ends, find

__all__ = ["Answer", "BackEnd", "Settings", "back_ends", "find"]
