"""Functions that tests send to other processes, which import little with them."""

import os
import signal
import sys
import threading
import time

import numpy as np

from optid.errors import StructureError


def slow_square(x, seconds=None):
    time.sleep(0.01)
    return x * x


def die_of_one(x, seconds=None):
    return os._exit(1) if x == 1 else x


def hang(x, seconds=None):
    return time.sleep(600) if x else x


def fail(x, seconds=None):
    raise ZeroDivisionError(f"of {x}")


def anonymous():
    return lambda view: {"small": view["a"][0] <= 0.5}


def negative():
    return lambda view: {"falling": view["mu"][0] <= -0.1}


def die(number):
    os.kill(os.getpid(), number)


def killed_by_options(program, settings):
    from optid.backends.conic import solve_with

    return die(signal.SIGKILL) if settings.options else solve_with("clarabel", program, settings)


def held(count):
    return np.ones(count, dtype=np.uint8).size


def refuse(text):
    raise StructureError(text)


class Awkward(Exception):
    def __init__(self, first, second):
        super().__init__(f"{first} {second}")


def awkward():
    raise Awkward("left", "right")


def surroundings():
    return os.getcwd(), sys.path, os.environ.get("OPTID_TEST")


def map_to_list(function):
    return [function()]


def anything(one):
    return one


LOCK = threading.Lock()


def locked(value):
    with LOCK:
        return value


def abort(path, names):
    die(signal.SIGABRT)


def sleep(path, names):
    time.sleep(60)
