"""Run tests with kernels that check every index; print the kernels that none of them has called.

NUMBA_BOUNDSCHECK must be set, and NUMBA_CACHE_DIR name an empty folder: cached code checks nothing. argv: tests.
"""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import optid
from optid import kernel_cache

kernels, compile_kernel = [], kernel_cache.cached_njit


def recorded(function=None, /, **options):
    if function is None:
        return lambda one: recorded(one, **options)
    kernel = compile_kernel(function, **options)
    if options.get("inline") != "always":  # which is compiled, and checked, with its callers
        kernels.append(kernel)
    return kernel


kernel_cache.cached_njit = recorded
home = Path(optid.__file__).parent
for path in home.rglob("*.py"):
    if "@cached_njit" in path.read_text(encoding="utf-8"):
        import_module(".".join(("optid", *path.relative_to(home).with_suffix("").parts)))
code = pytest.main(["-q", "-n", "0", "-p", "no:cacheprovider", "-m", "", *sys.argv[1:]])
rng = np.random.default_rng(0)
u = rng.uniform(-1, 1, 50_000)
y = np.where(rng.random(u.size) < 0.9, np.roll(u, 1) ** 3, np.nan)  # with gaps everywhere
optid.fit(optid.Data(u, y), "hammerstein_arx.overparametrised", na=1, nb=2, basis="triangular:60")
idle = sorted(f"{kernel.py_func.__module__}.{kernel.py_func.__name__}" for kernel in kernels if not kernel.signatures)
print("not called:", *idle)
sys.exit(code or bool(idle))
