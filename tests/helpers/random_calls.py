"""Random calls of `optid.fit`: records, orders, bases, constraints and options, good ones and nonsense."""

import signal
import warnings
from contextlib import contextmanager
from inspect import signature

import numpy as np

import optid
from optid.errors import DataWarning, OptidError
from optid.registry import FORMULATIONS, find_entry_points

NUMBERS = (0, 1, 2, 3, 5, -1, 1.5, float("nan"), 10**20, "2", None, True, 40, [1, 2], np.int64(2))
WEIGHTS = (0.0, 0.1, 1e3, -1.0, float("nan"), float("inf"), 1e300, "huber", None)
BASES = ("polynomial:3", "polynomial:0", "polynomial:1.5", "polynomial:40", "triangular:8", "triangular",
         "triangular:99999999999", "bspline:6", "piecewiseconstant:4", "trigonometric:2", "linear", "nope", "", ":", 3,
         None, ["polynomial:2", "triangular:4"], optid.Triangular(6), optid.Polynomial(2, interval=(1.0, -1.0 + 3)))
CONSTRAINTS = ("monotone:increasing", "monotone:decreasing", "monotone:up", "monotone", "saturation:-0.5:0.5",
               "saturation:1", "range:-1:1", "range:1:-1", "range:nan:1", "gain:1.0", "gain:0", "gain:inf", "gain:x",
               "gain", "stable", "stable:0.9", "stable:2", "stable:0", "odd", "convex", "concave", "nope",
               "", ":", "deadzone:0.2", 3, None, lambda v: {"a": v["a"] <= 1}, lambda v: v["nothing"] >= 0,
               lambda v: 3, lambda v: {"b": v["b"] >= 0, "c": v["b"] <= -1})
SHARED = {"nb": NUMBERS, "na": NUMBERS, "nk": NUMBERS, "nx": NUMBERS, "nc": NUMBERS, "nd": NUMBERS, "basis": BASES,
          "ridge": WEIGHTS, "curvature": WEIGHTS, "weight": WEIGHTS,
          "loss": ("squares", "huber", "huber:2", "huber:x", "l1", "", 3),
          "prior": ("none", "tc", "dc", "ss", "nope", 2), "gauge": ("norm", "gain", "b0", "nope", None),
          "criterion": ("simulation", "prediction", "nope"), "block_rows": NUMBERS, "starts": NUMBERS}
USUAL = {"nb": 2, "na": 1, "nk": 0, "nx": 2, "nc": 1, "nd": 1, "basis": "polynomial:2", "weight": 0.1, "order": 2}
PLAIN = {"accuracy": (1e-8, 1e-4, 0, -1.0, float("nan"), "x", 1.0, None), "raises": (True, False),
         "solver": ("auto", "auto", "clarabel", "ipopt", "gauss_newton", "scs", "nope", 3, "")}


def record(rng: np.random.Generator) -> tuple[object, object]:
    """Draw inputs and outputs, of any length, shape, type and size."""
    count = int(rng.choice([0, 1, 2, 3, 7, 30, 80, 200]))
    m, l = int(rng.choice([1, 1, 1, 2])), int(rng.choice([1, 1, 1, 2]))  # noqa: E741
    u = rng.uniform(-1, 1, (count, m))
    y = np.zeros((count, l))
    for k in range(1, count):
        y[k] = 0.5 * y[k - 1] + np.tanh(u[k - 1].sum())
    y += 0.05 * rng.standard_normal(y.shape)
    found = []
    for x in (u, y):
        what = rng.choice(["plain"] * 24 + ["gaps", "inf", "constant", "huge", "tiny", "float32", "int8", "object",
                                            "text", "complex", "flat", "transposed", "shorter", "list", "bool"])
        if what == "gaps":
            x = np.where(rng.random(x.shape) < 0.2, np.nan, x)
        elif what == "inf":
            x = np.where(rng.random(x.shape) < 0.1, np.inf, x)
        elif what == "constant":
            x = np.full_like(x, 3.0)
        elif what in ("huge", "tiny"):
            x = x * (1e160 if what == "huge" else 1e-200)
        elif what in ("float32", "int8", "object", "complex", "bool"):
            x = (3 * x).astype(what)
        elif what == "text":
            x = x.astype(str)
        elif what == "flat":
            x = x.ravel()
        elif what == "transposed":
            x = x.T
        elif what == "shorter":
            x = x[:-1]
        elif what == "list":
            x = x.tolist()
        found.append(x)
    return found[0], found[1]


def draw(seed: int) -> tuple[tuple[object, object], str, dict]:
    """Return a record, the name of a formulation, and its arguments, most of which make sense."""
    rng = np.random.default_rng([seed, 77])
    name = str(rng.choice(sorted(find_entry_points(FORMULATIONS))))
    known = signature(find_entry_points(FORMULATIONS)[name].load()).parameters
    given = {key: value for key, value in USUAL.items() if key in known}
    for _ in range(int(rng.integers(0, 4))):
        key = str(rng.choice([*(k for k in SHARED if k in known), *PLAIN, str(rng.choice(list(SHARED)))]))
        values = (SHARED | PLAIN)[key]
        given[key] = values[int(rng.integers(len(values)))]
    if rng.random() < 0.4:
        given["constraints"] = [CONSTRAINTS[int(i)] for i in rng.integers(len(CONSTRAINTS), size=rng.integers(1, 3))]
    return record(rng), name, given


class NoEnd(BaseException):
    """A call that takes too long; not an `Exception`, which what is called might handle."""


@contextmanager
def limited(seconds: int):
    """Interrupt what takes longer."""
    def stop(number, frame):
        raise NoEnd(f"no end within {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def trouble(seed: int) -> str:
    """Make the call; return what is wrong with how it ended, nothing where it is a fit or an error of optid."""
    (u, y), name, given = draw(seed)
    kept = [np.array(x, copy=True) if isinstance(x, np.ndarray) else x for x in (u, y)]
    said = f"{seed}: {name} {given}"
    with warnings.catch_warnings(record=True, action="always") as heard, limited(60):
        try:
            fit = optid.fit(optid.Data(u, y), name, **given)
            str(fit), fit.verdict
        except OptidError:
            pass
        except BaseException as error:
            return f"{said} -> {type(error).__name__}: {error}"[:600]
    if strange := [w for w in heard if not issubclass(w.category, DataWarning)]:
        return f"{said} -> warns {strange[0].category.__name__}: {strange[0].message}"[:600]
    for x, before in zip((u, y), kept):
        if isinstance(x, np.ndarray) and not np.array_equal(x, before, equal_nan=x.dtype.kind in "fc"):
            return f"{said} -> changed an array"
    return ""
