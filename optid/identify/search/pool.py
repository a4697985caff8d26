"""Trials side by side, in processes that work until the search is over or its time is."""

import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from typing import Any

from optid.packing import Unsendable, pack
from optid.processes import LONGEST, Worker, start_workers

GRACE = 1.0  # seconds after a deadline, which work looks at itself


class Pool:
    """Runs a function of one argument in processes of their own, or here if one is enough or none can be used.

    Attributes:
        reason: why no other process can be used, "" otherwise.
    """

    def __init__(self, function: Callable[[Any], Any], count: int) -> None:
        """Start `count` processes and send them the function."""
        self._function, self._idle, self._busy, self.reason = function, list[Worker](), dict[Worker, int](), ""
        if count < 2:
            return
        try:
            self._idle = start_workers(count, pack(function))
        except (Unsendable, ChildProcessError) as error:
            self.reason = str(error)

    def run(self, tasks: Sequence[Any], deadline: float, told: Callable[[Any], None]) -> list[Any]:
        """Return the results in the order of the tasks, None for those that time or a process did not last for.

        The deadline is by `time.monotonic`; `told` is told every result as it comes. What the function raises is raised
        here.
        """
        results: list[Any] = [None] * len(tasks)
        if not self._idle:
            for i, task in enumerate(tasks):
                if time.monotonic() < deadline:
                    results[i] = self._function(task)
                    told(results[i])
            return results
        waiting = list(range(len(tasks)))[::-1]
        while (waiting and self._idle) or self._busy:
            while waiting and self._idle and time.monotonic() < deadline:
                worker, i = self._idle.pop(), waiting.pop()
                self._busy[worker] = i
                try:
                    worker.request(None, pack((tasks[i],)))
                    worker.wait_until_begun()
                except ChildProcessError:
                    self._drop(worker)
            if not self._busy:
                break
            left = max(deadline + GRACE - time.monotonic(), 0.0)
            by_connection = {worker.connection: worker for worker in self._busy}
            ready: list[Any] = wait(list(by_connection), None if left > LONGEST else left)
            if not ready:
                self.close()
                break
            for worker in map(by_connection.__getitem__, ready):
                try:
                    result = worker.receive()
                except ChildProcessError:  # it died: the others go on
                    self._drop(worker)
                    continue
                i = self._busy.pop(worker)
                self._idle.append(worker)
                results[i] = result
                told(result)
        return results

    def close(self) -> None:
        """End the processes that work, and keep the others for later use."""
        while self._busy:
            self._drop(next(iter(self._busy)))
        while self._idle:
            self._idle.pop().rest()

    def _drop(self, worker: Worker) -> None:
        del self._busy[worker]
        worker.kill()
