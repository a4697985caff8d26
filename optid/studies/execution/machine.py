"""The description of this machine, and the resident memory of this process."""

import os
import platform
import resource
import sys
from functools import cache
from pathlib import Path

MB = 1e6
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@cache
def machine() -> str:
    """Return name, processor, cores, system and Python of this machine in one line."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    return (f"{platform.node()}, {processor}, {os.cpu_count()} cores, {platform.system()} {platform.release()}, "
            f"Python {platform.python_version()}")


def resident_mb() -> float:
    """Return the resident memory of this process now, in MB."""
    import psutil

    return psutil.Process().memory_info().rss / MB


class Peak:
    """Largest resident memory of this process since the object was made.

    Linux lets a process reset the figure. Elsewhere it is the largest of the whole life of the process if that has
    grown, else the larger of start and end.
    """

    def __init__(self) -> None:
        self.start, self._before = resident_mb(), _lifetime_mb()
        try:
            _CLEAR.write_text("5")
            self._exact = True
        except OSError:
            self._exact = False

    def mb(self) -> float:
        """Return the peak until now, in MB."""
        if self._exact:
            for line in _STATUS.read_text().splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024 / MB
        lifetime = _lifetime_mb()
        return lifetime if lifetime > self._before else max(self.start, resident_mb())


def _lifetime_mb() -> float:
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / MB if sys.platform == "darwin" else largest * 1024 / MB
