"""Where a cell runs: the machine in words."""

import os
import platform
from functools import cache
from pathlib import Path


@cache
def machine() -> str:
    """Return name, processor, cores, system and Python of this machine in one line."""
    return (f"{platform.node()}, {_processor()}, {os.cpu_count()} cores, {platform.system()} {platform.release()}, "
            f"Python {platform.python_version()}")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
