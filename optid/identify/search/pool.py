"""Trials side by side: forked processes that work until the search is over or its time is."""

import multiprocessing
import signal
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np

GRACE = 1.0  # seconds after a deadline, which work looks at itself


class Pool:
    """Runs a function of one argument in processes of their own; here where one is to do, or none can be forked.

    Processes are forked once, so that they know all that is known here, and load what they need once.
    """

    def __init__(self, function: Callable[[Any], Any], count: int) -> None:
        """Fork `count` processes."""
        self._function, self._connections, self._children = function, list[Any](), list[Any]()
        if count < 2 or "fork" not in multiprocessing.get_all_start_methods():
            return
        context = multiprocessing.get_context("fork")
        for _ in range(count):
            ours, theirs = context.Pipe()
            child = context.Process(target=_work, args=(theirs, function), daemon=True)
            with warnings.catch_warnings():  # forking a process with threads is deprecated; they are not used there
                warnings.simplefilter("ignore", DeprecationWarning)
                child.start()
            theirs.close()
            self._connections.append(ours)
            self._children.append(child)

    def run(self, tasks: Sequence[Any], deadline: float, told: Callable[[Any], None]) -> list[Any]:
        """Return the results in the order of the tasks, None for those that time or a process did not last for.

        The deadline is by `time.monotonic`; `told` is told every result as it comes.
        """
        results: list[Any] = [None] * len(tasks)
        if not self._connections:
            for i, task in enumerate(tasks):
                if time.monotonic() < deadline:
                    results[i] = self._function(task)
                    told(results[i])
            return results
        waiting, busy, idle = list(range(len(tasks)))[::-1], {}, list(self._connections)
        while (waiting and idle) or busy:
            while waiting and idle and time.monotonic() < deadline:
                connection = idle.pop()
                busy[connection] = waiting.pop()
                connection.send(tasks[busy[connection]])
            if not busy:
                break
            left = max(deadline + GRACE - time.monotonic(), 0.0)
            ready: list[Any] = wait(list(busy), None if left == np.inf else left)
            if not ready:
                self.close()
                break
            for connection in ready:
                i = busy.pop(connection)
                try:
                    results[i] = connection.recv()
                except EOFError:  # it died: the others go on
                    self._connections.remove(connection)
                    continue
                idle.append(connection)
                told(results[i])
        return results

    def close(self) -> None:
        """End the processes."""
        for child in self._children:
            child.kill()
        for child in self._children:
            child.join()
        for connection in self._connections:  # fewer where a process died
            connection.close()
        self._connections, self._children = [], []


def _work(connection: Connection, function: Callable[[Any], Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(EOFError):
        while True:
            connection.send(function(connection.recv()))
