"""Reduce the parts of a record to one result: on the threads of this machine, or as a tree of tasks on a Dask cluster.

The tree depends on the parts alone, so the result is the same to the last digit on one thread and on any number of
workers, also when workers die and their parts are read again elsewhere.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import chain, islice
from typing import Any, TypeVar

from optid.arrays import check_integer
from optid.data.reading.parts import Part
from optid.errors import OptidError, StructureError

One = TypeVar("One")
Result = TypeVar("Result")

FAN_IN = 8  # results that one task merges


def available_cores(number: int | None, name: str = "threads", error: type[OptidError] = StructureError) -> int:
    """Return the number of threads or processes asked for, a positive integer; None asks for one per core."""
    if number is not None:
        return check_integer(number, name, error=error)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_parts(function: Callable[[One], Result], parts: Iterable[One], threads: int) -> Iterator[Result]:
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


def reduce_parts(parts: Sequence[Part], leaf: Callable[[Part], Result], merge: Callable[[Sequence[Result]], Result],
                 scheduler: Any = None, threads: int = 1) -> Result:
    """Return the results of `leaf` on all parts (at least one), merged.

    `leaf` is sent to the workers; `merge` takes at most `FAN_IN` neighbouring results, in order, and must not change
    them. The scheduler is the address of one of Dask, a `distributed.Client`, or None for this machine, where the
    partitions of Dask collections are computed by Dask's current one. `ClusterError`: the cluster cannot be used.
    """
    if scheduler is None and all(part.content is None for part in parts):
        return tree(map_parts(leaf, parts, threads), len(parts), merge)
    from dask.delayed import delayed

    task = delayed(_of_part, pure=False)
    leaves = [task(leaf, replace(part, content=None), part.content) for part in parts]
    return _computed(tree(leaves, len(leaves), delayed(merge, pure=False)), scheduler)


def tree(results: Iterable[Any], count: int, merge: Callable[[Sequence[Any]], Any]) -> Any:
    """Merge so many results, at least one, by a tree; of an iterator at most `FAN_IN` of each level are in memory."""
    while count > 1:
        results, count = _merged(results, merge), -(-count // FAN_IN)
    (root,) = results
    return root


def _merged(results: Iterable[Any], merge: Callable[[Sequence[Any]], Any]) -> Iterator[Any]:
    rest = iter(results)
    while neighbours := list(islice(rest, FAN_IN)):
        yield merge(neighbours)


def fetch_part(part: Part, scheduler: Any = None) -> Part:
    """Return a part with its content, computed where it is a Dask collection."""
    return part if part.content is None else replace(part, content=_computed(part.content, scheduler))


def _computed(task: Any, scheduler: Any) -> Any:
    if scheduler is None:
        from dask.base import compute

        return compute(task)[0]
    from optid.data.clusters import connect_cluster, result_of

    with connect_cluster(scheduler) as client:
        return result_of(client, task)


def _of_part(leaf: Callable[[Part], Any], part: Part, content: Any) -> Any:
    return leaf(replace(part, content=content))
