"""Back ends: the only place that knows a solver."""

from optid.backends.back_end import Answer, BackEnd, Settings
from optid.backends.choice import back_ends, find

__all__ = ["Answer", "BackEnd", "Settings", "back_ends", "find"]
