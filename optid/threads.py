"""One thread for linear algebra: the matrices here are small, and threads would mostly wait for each other.

On a processor that has other work, threads that wait actively make a fit ten times slower; and the last digits of a
result would depend on their number.
"""

from collections.abc import Callable
from functools import cache, wraps
from threading import local
from typing import Any, TypeVar

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Variables of the environment that a fresh interpreter takes the number of its threads from."""

Function = TypeVar("Function", bound=Callable[..., Any])
_calls = local()  # whether this Python thread is inside a function that runs with one thread


def one_thread(function: Function) -> Function:
    """Run a function with one thread for linear algebra; afterwards there are as many as before."""
    @wraps(function)
    def alone(*arguments: Any, **options: Any) -> Any:
        if getattr(_calls, "inside", False):
            return function(*arguments, **options)
        with _libraries().limit(limits=1):
            _calls.inside = True
            try:
                return function(*arguments, **options)
            finally:
                _calls.inside = False

    return alone  # type: ignore[return-value]


@cache
def _libraries() -> Any:
    import scipy.linalg  # noqa: F401  # its library must be loaded to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
