"""Scripts outside the packages that the tests load."""

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

BENCHMARKS = str(Path(__file__).parents[2] / "benchmarks")


def benchmark(name: str) -> ModuleType:
    """Load a script of the folder benchmarks, which is first on the path when one runs it."""
    sys.path.insert(0, BENCHMARKS)
    try:
        return import_module(name)
    finally:
        sys.path.remove(BENCHMARKS)
