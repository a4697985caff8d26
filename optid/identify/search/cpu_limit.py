"""A limit of CPU time on what runs inside, also where it is one long call."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

MOMENT = 0.01  # CPU seconds until it is raised again where it could not get out


class OutOfTime(BaseException):  # noqa: N818 - an event, which nothing between may take for its own error
    """The CPU time is over."""


@contextmanager
def cpu_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` after so many CPU seconds of this process.

    Python looks at it between two operations. Where these are the last ones of an object or of a garbage collection no
    exception gets out: it is raised again a moment later. Where there is no such timer (Windows, other threads than
    the main one) nothing is raised: whoever works in steps also looks at the clock between them.
    """
    timer = getattr(signal, "ITIMER_PROF", None)
    if timer is None or not 0 < seconds < 1e9 or threading.current_thread() is not threading.main_thread():
        yield
        return

    def over(*_: Any) -> None:
        raise OutOfTime

    def ignore(args: "sys.UnraisableHookArgs") -> None:
        if isinstance(args.exc_value, OutOfTime):
            signal.setitimer(timer, MOMENT)
        else:
            hook(args)

    hook = sys.unraisablehook
    before = signal.signal(signal.SIGPROF, over)
    sys.unraisablehook = ignore
    signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        signal.setitimer(timer, 0)
        sys.unraisablehook = hook
        signal.signal(signal.SIGPROF, before or signal.SIG_DFL)
