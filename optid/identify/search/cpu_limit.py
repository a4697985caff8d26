"""A limit of CPU time on what runs inside, also where it is one long call."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class OutOfTime(BaseException):  # noqa: N818 - an event, which nothing between may take for an error of its own
    """The CPU time is over."""


@contextmanager
def cpu_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` after so many CPU seconds of this process.

    Python looks at it between two operations. Where there is no such timer (Windows, other threads than the main one)
    nothing is raised: whoever works in steps also looks at the clock between them.
    """
    timer = getattr(signal, "ITIMER_PROF", None)
    if timer is None or not 0 < seconds < 1e9 or threading.current_thread() is not threading.main_thread():
        yield
        return

    def over(*_: Any) -> None:
        raise OutOfTime

    before = signal.signal(signal.SIGPROF, over)
    signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        signal.setitimer(timer, 0)
        signal.signal(signal.SIGPROF, before or signal.SIG_DFL)
