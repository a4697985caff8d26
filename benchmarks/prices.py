"""Is the price of a constraint what moving its bound gains?

    python benchmarks/prices.py [--problems 200] [--solver auto]

For every constraint word random records are fitted with a bound that binds, and twice more with the bound moved a
little to either side. The multiplier that the fit reports must be the difference quotient. Words with a number are
asked for again with another number; the others (monotone, odd, ...) are written out, with their zero moved.
"""

import argparse
import warnings
from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np

import optid
from formulations.constraints import shape
from formulations.constraints.shape import _flat, _mirror

EXACT, RELAXED = "hammerstein_arx.exact", "hammerstein_arx.overparametrised"


def record(seed: int, curve: Callable[[np.ndarray], np.ndarray], size: float, unit: float) -> optid.Data:
    """A second-order system with a random numerator of positive gain; y in some unit, u in another."""
    rng = np.random.default_rng(seed)
    u, e = rng.uniform(-1, 1, 150), 0.3 * rng.standard_normal(150)
    b, y = np.array([1.0, 0.5 + 0.4 * rng.random()]), np.zeros(150)
    for k in range(2, 150):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + b @ curve(u[[k, k - 1]]) + e[k]
    return optid.Data(u=unit * u, y=size * y)


def rows(build: Callable[[Any], np.ndarray], equal: bool) -> Callable[[float], Any]:
    """Rows on the coefficients of f that are not negative, or zero, up to t."""

    def moved(t: float) -> Any:
        def constraint(view: Any) -> dict[str, Any]:
            matrix = build(next(iter(view.bases.values())))
            x = view["mu"] if "mu" in view else view["Theta"] if equal else cp.sum(view["Theta"], axis=1)
            if equal:
                return {"moved": [matrix @ x <= t, matrix @ x >= -t]}
            return {"moved": [matrix @ x >= -t, *([cp.sum(view["b"]) >= 0] if "b" in view else [])]}

        return constraint

    return moved


def tanh(u: np.ndarray) -> np.ndarray:
    return np.tanh(2 * u)


def bent(u: np.ndarray) -> np.ndarray:
    return np.tanh(2 * u) + 0.5 * u**2


def falling(u: np.ndarray) -> np.ndarray:
    return np.sin(4 * u)


Case = tuple[Any, Callable[[float], Any], Callable[[np.ndarray], np.ndarray], dict[str, Any]]


def cases(r: float, s: float) -> dict[str, Case]:
    """{word: (constraint, t -> the constraint with its bound moved by t in its own units, curve, orders)}.

    Args:
        r: unit of y.
        s: unit of u.
    """
    g = r / s
    return {
        "monotone": (shape.monotone(), rows(lambda b: b.increments(), False), falling, {}),
        "convex": (shape.convex(), rows(lambda b: b.curvature(), False), tanh, {}),
        "concave": (shape.concave(), rows(lambda b: -b.curvature(), False), tanh, {}),
        "odd": (shape.odd(), rows(lambda b: _mirror(b, 1.0), True), bent, {}),
        "even": (shape.even(), rows(lambda b: _mirror(b, -1.0), True), bent, {}),
        "dead_zone": (shape.dead_zone(-0.3 * s, 0.3 * s), rows(lambda b: _flat(b, -0.3 * s, 0.3 * s), True), tanh, {}),
        "saturation": (shape.saturation(high=0.3 * s), rows(lambda b: _flat(b, 0.3 * s, b.interval[1]), True), bent,
                       {}),
        "slope low": (shape.slope(low=2.0 * g), lambda t: shape.slope(low=2.0 * g + t), tanh, {}),
        "slope high": (shape.slope(high=6.0 * g), lambda t: shape.slope(high=6.0 * g + t), tanh, {}),
        "range low": (shape.value_range(low=-4.0 * r), lambda t: shape.value_range(low=-4.0 * r + t), tanh, {}),
        "range high": (shape.value_range(high=4.0 * r), lambda t: shape.value_range(high=4.0 * r + t), tanh, {}),
        "through": (shape.through(0.5 * s, 3.0 * r), lambda t: shape.through(0.5 * s, 3.0 * r + t), tanh, {}),
        "gain": (shape.gain(6.0 * g), lambda t: shape.gain(6.0 * g + t), tanh, {}),
        "gain high": (shape.gain(high=7.0 * g), lambda t: shape.gain(high=7.0 * g + t), tanh, {}),
        "coefficients": (shape.coefficients("a", low=-1.0, index=0),
                         lambda t: shape.coefficients("a", low=-1.0 + t, index=0), tanh, {}),
        "offset": (shape.coefficients("offset", high=-0.2 * r),
                   lambda t: shape.coefficients("offset", high=-0.2 * r + t), tanh, {}),
        "sign": (shape.sign("a", "negative"), lambda t: lambda v: {"moved": v["a"] <= t}, tanh, {}),
        "stable, na 1": (shape.stable(0.6), lambda t: shape.stable(0.6 + t), tanh, {"na": 1}),
        "stable, na 2": (shape.stable(0.6), lambda t: shape.stable(0.6 + t), tanh, {"na": 2}),
        "stable, na 3": (shape.stable(0.6), lambda t: shape.stable(0.6 + t), tanh, {"na": 3}),
        "a constraint of the user": (lambda v: {"moved": v["Theta"][5, 1] <= 0.2 * r},
                                     lambda t: lambda v: {"moved": v["Theta"][5, 1] <= 0.2 * r + t}, tanh, {}),
    }


BANDS = ("odd", "even", "dead_zone", "saturation")
"""Words that hold exactly: they can only be relaxed, to a band."""


def checked(word: str, seed: int, formulation: str, solver: str = "auto", r: float = 1.0, s: float = 1.0
            ) -> tuple[float, float]:
    """Return the multiplier that a fit reports, and the slope of the objective by refits with the bound moved."""
    rule, moved, curve, orders = cases(r, s)[word]
    data = record(seed, curve, r, s)
    basis = optid.Triangular(6, interval=(-s, s))

    def fitted(constraint: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return optid.fit(data, formulation, basis=basis, constraints=[constraint], solver=solver, accuracy=1e-11,
                             **{"na": 2, "nb": 2, **orders})

    base = fitted(rule)
    price = base.prices[0]
    step = 0.02 * price.step
    if word in BANDS:  # to one side, the curvature taken out
        here, half, whole = (one.solution.objective for one in (base, *(fitted(moved(t)) for t in (step / 2, step))))
        return price.multiplier, (2 * (here - half) / (step / 2) - (here - whole) / step)
    up, down = (fitted(moved(sign * step)).solution.objective for sign in (1, -1))
    return price.multiplier, abs(up - down) / (2 * step)


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=200)
    parser.add_argument("--solver", default="auto")
    options = parser.parse_args(argv)
    words, worst, outside, count = list(cases(1.0, 1.0)), {}, 0, 0
    while count < options.problems:
        word, seed = words[count % len(words)], count // len(words)
        formulation = (EXACT, RELAXED)[seed % 2]
        r, s = 10.0 ** np.random.default_rng(count).uniform(-6, 6, 2)
        multiplier, quotient = checked(word, seed, formulation, options.solver, r, s)
        error = abs(multiplier / quotient - 1) if quotient else abs(multiplier)
        worst[word] = max(worst.get(word, (0.0, 0)), (error, seed))
        outside += error > 0.01
        count += 1
    for word, (error, seed) in worst.items():
        print(f"{word:26s} largest deviation {100 * error:8.4f} % (seed {seed})")
    print(f"{count} problems, {outside} with more than 1 %")


if __name__ == "__main__":
    main()
