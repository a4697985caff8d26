"""Forty fits whose figures a change of how they are computed must not move.

    python tests/golden_fits.py [--write] [WORD ...]

Prints what differs from the recorded figures (`golden_fits.json`); --write records the figures of the fits whose names
contain one of the words, or of all. Recorded are objective, status, proof, verdict, multipliers and prices, standard
errors, the free run, and the figures of the printed text, without its wording.

Tolerances are those of the method: an equation error has one optimum to the accuracy of a factorisation; a descent on
simulation or prediction errors, or on the likelihood of a prior, ends within 1e-6 of its own, where multipliers hold
half the digits; subspace procedures pass on the accuracy of the conic programmes on their way.
"""

import argparse
import json
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import optid
from optid.models.recursions import lfilter

RECORD = Path(__file__).with_name("golden_fits.json")
SAMPLES = (40, 90, 140, 190, 240)  # of the free run that are recorded
ROUNDING = 1e-12
FIGURE = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.]*\d)")
CHANCE = re.compile(r"Total|steps|[Gg]ap|p = |Iterations|Condition|instant")  # of time, rounding and chance


@dataclass(frozen=True)
class Tolerances:
    """Largest relative differences of objective, multipliers and prices, standard errors, and the free run."""

    objective: float
    multipliers: float
    errors: float
    run: float


EQUATION = Tolerances(1e-9, 1e-6, 1e-6, 1e-7)
CONIC = Tolerances(1e-7, 1e-4, 1e-4, 1e-4)
DESCENT = Tolerances(1e-6, 1e-4, 1e-3, 1e-4)
SHIFT = Tolerances(2e-5, 1e-3, 1e-3, 1e-3)


@cache
def plant(kind: str = "siso", seed: int = 0) -> optid.Data:
    """300 samples of a second-order plant behind tanh; of two inputs; of two inputs and outputs; of two experiments."""
    rng = np.random.default_rng(seed)
    count, m = (300, 2 if kind in ("miso", "mimo") else 1)
    u = rng.uniform(-1, 1, (count, m))
    v = np.column_stack([np.tanh(2 * u[:, 0]), *([u[:, 1] + 0.5 * u[:, 1] ** 2] if m > 1 else [])])
    if kind == "linear":
        v = u
    ways = [[([1.0, 0.6], [1, -1.2, 0.45])], [([0.5], [1, -0.7])]]
    y = sum(lfilter(np.r_[0.0, ways[c][0][0]], ways[c][0][1], v[:, c]) for c in range(m))[:, None] + 0.3
    if kind == "mimo":
        y = np.column_stack([y, lfilter([0.0, 0.8], [1, -0.5], v[:, 0]) - lfilter([0.0, 0.4], [1, -0.8], v[:, 1])])
    if kind == "coloured":
        y = y + 0.2 * lfilter([1.0], [1, -0.8], rng.standard_normal(count))[:, None]
    y = y + 0.1 * rng.standard_normal(y.shape)
    if kind == "experiments":
        return optid.Data([u[:150], u[150:]], [y[:150], y[150:] + 2.0])
    if kind == "gaps":
        y[rng.random(count) < 0.1] = np.nan
    return optid.Data(u, y)


@cache
def loop() -> optid.Data:
    """300 samples of a first-order plant with tanh of its output fed back."""
    rng = np.random.default_rng(1)
    u, x = rng.uniform(-2, 2, 300), np.zeros(301)
    for k in range(300):
        x[k + 1] = 0.8 * x[k] - 0.5 * np.tanh(x[k]) + u[k] + 0.02 * rng.standard_normal()
    return optid.Data(u, x[:300] + 0.02 * rng.standard_normal(300))


def tank(v: Any) -> dict[str, Any]:
    """A tank that leaks with the cube of its level."""
    return {"x": v["a"] * v["x"] - v["c"] * v["x"] ** 3 + v["b"] * v["u"], "y": v["x"] + v["d"]}


def bent() -> optid.Data:
    """200 samples of such a tank."""
    rng = np.random.default_rng(0)
    u, x = rng.uniform(-1, 1, 200), np.zeros(201)
    for k in range(200):
        x[k + 1] = 0.9 * x[k] - 0.2 * x[k] ** 3 + 0.5 * u[k]
    return optid.Data(u, x[:200] + 0.4 + 0.05 * rng.standard_normal(200))


def fits() -> dict[str, tuple[Tolerances, Callable[[], Any]]]:
    """{name: (tolerances, call)} of all fits."""
    def one(record: Callable[[], optid.Data], formulation: str, **arguments: Any) -> Callable[[], Any]:
        return lambda: optid.fit(record(), formulation, **arguments)

    siso, linear, miso, mimo = plant, lambda: plant("linear"), lambda: plant("miso"), lambda: plant("mimo")
    coloured, gaps, experiments = lambda: plant("coloured"), lambda: plant("gaps"), lambda: plant("experiments")
    arx, hammerstein = dict(na=2, nb=2, nk=1), dict(na=2, nb=2, nk=1, basis="polynomial:3")
    exact, nuclear = "hammerstein_arx.exact", "hammerstein_arx.nuclear"
    tanks = optid.Equations(tank, {"x": 0.1}, {"a": 0.5, "b": 0.8, "c": 0.1, "d": 0.1}, time="discrete")
    return {
        "arx": (EQUATION, one(linear, "arx", **arx)),
        "arx two outputs": (EQUATION, one(mimo, "arx", **arx)),
        "arx a level each": (EQUATION, one(experiments, "arx", offset="each", **arx)),
        "arx gain, sign": (EQUATION, one(linear, "arx", constraints=["gain:6", "sign:b,positive"], **arx)),
        "arx stable": (CONIC, one(linear, "arx", constraints=["stable:0.6"], **arx)),
        "arx tc": (DESCENT, one(linear, "arx", prior="tc", **arx)),
        "arx huber": (CONIC, one(linear, "arx", loss="huber", **arx)),
        "fir dc": (DESCENT, one(linear, "fir", nb=30)),
        "exact": (EQUATION, one(siso, exact, **hammerstein)),
        "exact two inputs": (EQUATION, one(miso, exact, **hammerstein)),
        "exact two outputs": (EQUATION, one(mimo, exact, **hammerstein)),
        "exact triangular, monotone, unit gain": (EQUATION, one(
            siso, exact, na=2, nb=2, nk=1, basis="triangular:8", constraints=["monotone:increasing", "gain:5"])),
        "exact odd, range": (EQUATION, one(siso, exact, constraints=["odd", "range:-1.2,1.2"], **hammerstein)),
        "exact gauge of the gain, convex": (EQUATION, one(siso, exact, gauge="gain", constraints=["convex"],
                                                          **hammerstein)),
        "exact stable": (CONIC, one(siso, exact, constraints=["stable:0.6"], **hammerstein)),
        "exact ridge, curvature": (EQUATION, one(siso, exact, ridge=1.0, curvature=0.1, **hammerstein)),
        "nuclear": (CONIC, one(siso, nuclear, weight=1.0, **hammerstein)),
        "nuclear two inputs, a rule": (CONIC, one(miso, nuclear, weight=1.0, constraints=[
            lambda v: {"bounded": v["Theta[u1]"][0] <= 0.5}], **hammerstein)),
        "overparametrised": (EQUATION, one(siso, "hammerstein_arx.overparametrised", **hammerstein)),
        "sid": (SHIFT, one(siso, "hammerstein_ss.sid", nx=2, basis="polynomial:3")),
        "sid stable": (SHIFT, one(linear, "hammerstein_ss.sid", nx=2, basis="linear", constraints=["stable:0.6"])),
        "sivid": (SHIFT, one(mimo, "hammerstein_ss.sivid", nx=3, basis="polynomial:2")),
        "asivid with feedback": (SHIFT, one(loop, "hammerstein_ss.asivid", nx=1, basis="linear",
                                            feedback_basis="polynomial:3")),
        "subspace nuclear": (SHIFT, one(linear, "subspace.nuclear", nx=2)),
        "oe": (DESCENT, one(linear, "oe.exact", **arx)),
        "oe gain": (DESCENT, one(linear, "oe.exact", constraints=["gain:6"], **arx)),
        "oe stable": (DESCENT, one(linear, "oe.exact", constraints=["stable:0.6"], **arx)),
        "hammerstein oe monotone": (DESCENT, one(siso, "hammerstein_oe.exact", constraints=["monotone:increasing"],
                                                 na=2, nb=2, nk=1, basis="triangular:8")),
        "hammerstein oe gaps": (DESCENT, one(gaps, "hammerstein_oe.exact", **hammerstein)),
        "armax": (DESCENT, one(coloured, "hammerstein_armax.exact", nc=1, **hammerstein)),
        "bj": (DESCENT, one(coloured, "hammerstein_bj.exact", nc=0, nd=1, **hammerstein)),
        "ss two outputs": (DESCENT, one(mimo, "ss.exact", nx=3)),
        "ss prediction": (DESCENT, one(coloured, "ss.exact", nx=2, criterion="prediction")),
        "ss stable": (DESCENT, one(linear, "ss.exact", nx=2, constraints=["stable:0.6"])),
        "hammerstein ss monotone": (DESCENT, one(siso, "hammerstein_ss.exact", nx=2, basis="triangular:8",
                                                 constraints=["monotone:increasing"])),
        "hammerstein ss with feedback": (DESCENT, one(loop, "hammerstein_ss.exact", nx=1, basis="linear",
                                                      feedback_basis="polynomial:3")),
        "lfr": (DESCENT, one(loop, "lfr.exact", nx=1, latent="states", latent_basis="polynomial:3")),
        "shooting": (DESCENT, one(linear, "hammerstein_oe.shooting", basis="linear", **arx)),
        "ss shooting": (DESCENT, one(linear, "ss.shooting", nx=2)),
        "physical": (DESCENT, one(bent, "physical", equations=tanks)),
    }


def figures(fit: Any) -> dict[str, Any]:
    """Return what is recorded of a fit."""
    runs = fit.simulate()
    run = np.concatenate([np.atleast_1d(y).reshape(len(y), -1) for y in (runs if isinstance(runs, tuple) else (runs,))])
    lines = [line for line in str(fit).splitlines() if not CHANCE.search(line)]
    bound = fit.solution.bound
    return {
        "status": str(fit.solution.status), "proved": bool(bound is not None and bound.proved),
        "verdict": fit.verdict.word, "objective": float(fit.solution.objective),
        "prices": {p.name: [p.active, float(p.multiplier), float(p.fit_points)] for p in fit.prices},
        "errors": {row.name: float(row.error) for row in fit.params.rows if np.isfinite(row.error)},
        "run": [float(x) for x in run[[k for k in SAMPLES if k < len(run)]].ravel()],
        "text": FIGURE.findall("\n".join(lines)),
    }


def differences(name: str, now: dict[str, Any], before: dict[str, Any]) -> list[str]:
    """Say what has changed by more than the tolerances of a fit."""
    limits, found = fits()[name][0], []

    def compare(what: str, a: float, b: float, limit: float, size: float = ROUNDING) -> None:
        if not abs(a - b) <= limit * max(abs(b), size) and not (np.isnan(a) and np.isnan(b)):
            found.append(f"{name}: {what} {a!r}, recorded {b!r}")

    found += [f"{name}: {key} {now[key]}, recorded {before[key]}" for key in ("status", "proved", "verdict")
              if now[key] != before[key]]
    compare("objective", now["objective"], before["objective"], limits.objective)
    for part, limit in (("prices", limits.multipliers), ("errors", limits.errors)):
        if set(now[part]) != set(before[part]):
            found.append(f"{name}: {part} of {sorted(now[part])}, recorded of {sorted(before[part])}")
            continue
        for key, value in before[part].items():
            if part == "errors":
                compare(f"standard error of {key}", now[part][key], value, limit)
                continue
            if now[part][key][0] != value[0]:
                found.append(f"{name}: {key} has {now[part][key][0]} active rows, recorded {value[0]}")
            size = now["objective"], 100.0  # a multiplier that vanishes has the size of a rounding
            for what, a, b, least in zip(("multiplier", "price"), now[part][key][1:], value[1:], size):
                compare(f"{what} of {key}", a, b, limit, 1e-3 * least)
    deviation = float(np.std(before["run"]))
    if len(now["run"]) != len(before["run"]):
        found.append(f"{name}: a free run of other length")
    for k, (a, b) in enumerate(zip(now["run"], before["run"])):
        compare(f"figure {k} of the free run", a, b, limits.run, deviation)
    if len(now["text"]) != len(before["text"]):
        found.append(f"{name}: {len(now['text'])} figures in the text, recorded {len(before['text'])}")
    found += [f"{name}: the text says {a}, recorded {b}" for a, b in zip(now["text"], before["text"])
              if abs(float(a) - float(b)) > 1.01 * last_digit(b) + 10 * limits.errors * abs(float(b))]
    return found


def last_digit(figure: str) -> float:
    """Return one unit of the last digit of a printed figure."""
    mantissa, _, power = figure.partition("e")
    return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))


def quietly(call: Callable[[], Any]) -> Any:
    """Call without the remarks about the record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return call()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    recorded = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    for name, (_, call) in fits().items():
        if options.words and not any(word in name for word in options.words):
            continue
        now = figures(quietly(call))
        if options.write:
            recorded[name] = now
        found = differences(name, now, recorded[name]) if name in recorded else [f"{name}: not recorded"]
        print(f"{name}: {now['status']}, {now['objective']:.10g}, {now['verdict']}", *found, sep="\n    ", flush=True)
    if options.write:
        rows = (f"{json.dumps(name)}: {json.dumps(row)}" for name, row in recorded.items())
        RECORD.write_text("{\n" + ",\n".join(rows) + "\n}\n")


if __name__ == "__main__":
    main()
