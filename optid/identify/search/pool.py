"""Trials side by side, in processes that work until the search is over or its CPU time is."""

from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from typing import Any

import numpy as np

from optid.packing import Unsendable, pack
from optid.processes import Worker, start_workers

PATIENCE, GRACE = 10.0, 60.0  # seconds on the clock for each CPU second that is left, and more, before work is ended


class TrialPool:
    """Runs a function in processes of their own, or here if one is enough or none can be used.

    Attributes:
        apart: whether it runs in other processes.
        reason: why no other process can be used, "" otherwise.
    """

    def __init__(self, function: Callable[[Any, float], Any], count: int) -> None:
        """Start `count` processes and send them the function."""
        self._function, self._idle, self._busy = function, list[Worker](), dict[Worker, int]()
        self.apart, self.reason = False, ""
        if count < 2:
            return
        try:
            self._idle, self.apart = start_workers(count, pack(function)), True
        except (Unsendable, ChildProcessError) as error:
            self.reason = str(error)

    def run(self, tasks: Sequence[Any], seconds: Callable[[], float], told: Callable[[Any], None]) -> list[Any]:
        """Return the results in the order of the tasks, None for those that CPU time or a process did not last for.

        The function is called with a task and with the CPU seconds that are left when it begins; none is begun without
        any. `told` is told every result as it comes. What the function raises is raised here.
        """
        results: list[Any] = [None] * len(tasks)
        if not self.apart:
            for i, task in enumerate(tasks):
                if (left := seconds()) > 0:
                    results[i] = self._function(task, left)
                    told(results[i])
            return results
        waiting = list(range(len(tasks)))[::-1]
        while (waiting and self._idle) or self._busy:
            while waiting and self._idle and (left := seconds()) > 0:
                worker, i = self._idle.pop(), waiting.pop()
                self._busy[worker] = i
                try:
                    worker.request(None, pack((tasks[i], left)))
                    worker.wait_until_begun()
                except ChildProcessError:
                    self._drop(worker)
            if not self._busy:
                break
            by_connection = {worker.connection: worker for worker in self._busy}
            # what works looks at its CPU time itself; what hangs uses none
            left = max(seconds(), 0.0)
            ready: list[Any] = wait(list(by_connection), None if np.isinf(left) else PATIENCE * left + GRACE)
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
