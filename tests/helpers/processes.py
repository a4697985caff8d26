"""Processes seen from outside, for tests of what starts and ends them."""

import time
from contextlib import suppress

import psutil


def gone(pid):
    """Whether it has ended; one that nobody has asked for its exit code yet (a zombie) has."""
    with suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    return True


def cell_workers(pid):
    """Process numbers of the workers for cells that run below a process."""
    found = []
    for process in psutil.Process(pid).children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it has ended since it was listed
            if "optid.child" in " ".join(process.cmdline()):
                found.append(process.pid)
    return found


def wait_for(condition, seconds=180.0):
    """Wait until it holds; an AssertionError where it does not in time."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)
