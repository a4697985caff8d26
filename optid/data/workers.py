"""Work on the parts of a record in several threads, with an answer that does not depend on how they take turns."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import chain, islice
from typing import TypeVar

from optid.arrays import check_integer

Part = TypeVar("Part")
Result = TypeVar("Result")


def available_threads(threads: int | None) -> int:
    """Return the number of threads asked for; None asks for one per core that this process may use.

    Raises:
        StructureError: not a positive integer.
    """
    if threads is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return check_integer(threads, "threads")


def mapped(function: Callable[[Part], Result], parts: Iterable[Part], threads: int) -> Iterator[Result]:
    """Yield function(part) for every part, in the order of the parts.

    With one thread, or one part, nothing is started; else the calling thread reads the parts, one ahead of those at
    which the others compute. What `parts` or `function` raises is raised here, once the parts under way are done.
    """
    rest = iter(parts)
    head = list(islice(rest, 2 if threads > 1 else 0))
    if len(head) < 2:
        yield from map(function, chain(head, rest))
        return
    running: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for part in chain(head, rest):
            if len(running) > threads:
                yield running.popleft().result()
            running.append(pool.submit(function, part))
        while running:
            yield running.popleft().result()
