"""Kernels compiled by numba and kept on disk, where a cache that is damaged or cannot be written costs time alone.

numba has no option for this: `_cache` of its dispatchers, and the classes behind it, are not part of its documentation.
"""

import hashlib
import pickle
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, cast

from numba import config, njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.serialize import dumps

from optid.errors import DataWarning


def cached_njit(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile a function at its first call, without the GIL and with NumPy's rules for division, and cache the code.

    The options are those of `numba.njit`. A cache that cannot be used is a `DataWarning`, once.
    """
    if function is None:
        return partial(cached_njit, **options)
    kernel: Any = cast(Any, njit)(**{"nogil": True, "error_model": "numpy", **options})(function)
    try:
        kernel._cache = _Cache(function)
    except (RuntimeError, OSError):  # there is no folder that can be written
        _warn()
    return kernel


class _Sealed(CompileResultCacheImpl):
    """Entries of the cache with a checksum: code with a wrong byte would crash, or compute something else."""

    def reduce(self, data: Any) -> Any:
        packed = dumps(super().reduce(data))
        return hashlib.sha256(packed).digest(), packed

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        digest, packed = payload
        if hashlib.sha256(packed).digest() != digest:
            raise ValueError("wrong checksum")
        return super().rebuild(target_context, pickle.loads(packed))


class _Cache(FunctionCache):
    """The cache of a function, whose failures are warnings."""

    _impl_class = _Sealed

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        wanted = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
        if wanted and not self.cache_path.startswith(wanted):  # numba took another folder without a word
            _warn()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling garbage raises
            _warn()
        try:
            self.flush()
        except OSError:  # then the function is compiled each time
            self.disable()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except Exception:  # a full disk, a folder that is gone, or what was written there meanwhile
            _warn()


def _warn() -> None:
    """Say it in the same words for every kernel, so that a reader sees them once."""
    place = f" in {config.CACHE_DIR}" if config.CACHE_DIR else ""  # pyright: ignore[reportAttributeAccessIssue]
    warnings.warn(f"the cache of compiled kernels{place} is damaged or cannot be written: kernels are compiled again, "
                  "with the same results; delete numba's files (.nbi, .nbc), or name another folder in NUMBA_CACHE_DIR",
                  DataWarning, stacklevel=2)
