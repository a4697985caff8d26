"""Progress of long work: a bar with the time that is left on a terminal, and the log "optid" everywhere.

``logging.basicConfig(level=logging.INFO)`` shows the log in a script or a notebook.
"""

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

log = logging.getLogger("optid")


def track(steps: Iterable[T], what: str, total: int) -> Iterator[T]:
    """Yield the steps; show how many of the total are done, and how long the others will take.

    Args:
        steps: what is done one after the other.
        what: name of the work.
        total: number of steps.
    """
    clock = time.monotonic()
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import track as bar

        steps = bar(steps, description=what, total=total, transient=True, console=Console(stderr=True))
    done = 0
    for done, step in enumerate(steps, start=1):  # noqa: B007 - the last one is logged
        yield step
    log.info("%s: %d of %d steps in %.3g s", what, done, total, time.monotonic() - clock)


class Meter:
    """Progress of work of a known size; call it with a sentence, inside a ``with`` statement.

    Attributes:
        what: name of the work.
        total: its size.
        done: called for how much of it is done.
    """

    def __init__(self, what: str, total: float, done: Callable[[], float]) -> None:
        self.what, self.total, self.done, self._bar = what, total, done, None

    def __enter__(self) -> "Meter":
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import Progress

            self._bar = Progress(console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task(self.what, total=self.total)
            self._bar.start()
        return self

    def __call__(self, sentence: str) -> None:
        """Say what was done last."""
        log.debug("%s: %s", self.what, sentence)
        if self._bar is not None:
            self._bar.update(self._task, completed=self.done(),
                             description=f"{self.what}: {sentence.partition(', ')[2][:50]}")

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
