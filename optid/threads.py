"""One thread for linear algebra: the matrices here are small, and threads would mostly wait for each other.

On a processor that has other work, threads that wait actively make a fit ten times slower; and the last digits of a
result would depend on their number.
"""

from collections.abc import Callable
from functools import cache, wraps
from threading import Lock
from typing import Any, TypeVar

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Variables of the environment that a fresh interpreter takes the number of its threads from."""

Function = TypeVar("Function", bound=Callable[..., Any])


def one_thread(function: Function) -> Function:
    """Run a function with one thread for linear algebra; afterwards there are as many as before."""
    @wraps(function)
    def alone(*arguments: Any, **options: Any) -> Any:
        with _limit:
            return function(*arguments, **options)

    return alone  # type: ignore[return-value]


class _Limit:
    """The limit belongs to the process: the first function that needs it sets it, the last to end takes it back.

    Functions of several Python threads overlap without being nested, so that none could restore what it has found.
    """

    def __init__(self) -> None:
        self._lock, self._running, self._limiter = Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            if not self._running:
                self._limiter = _libraries().limit(limits=1)
            self._running += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._running -= 1
            if not self._running and self._limiter is not None:
                self._limiter.restore_original_limits()


_limit = _Limit()


@cache
def _libraries() -> Any:
    import scipy.linalg  # noqa: F401  # its library must be loaded to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
