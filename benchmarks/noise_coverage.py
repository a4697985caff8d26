"""Do 95 % intervals contain the truth in 95 % of the records, whatever the noise is?

    python benchmarks/noise_coverage.py [--runs 300] [--workers 2] [--cases output Jenkins ...]

Plants with known equations are simulated again and again, each time with new inputs and new noise: output errors,
ARMAX and Box-Jenkins models, white noise and noise of an autoregression .9, white inputs and slow ones, experiments
whose noise differs, missing outputs, and constraints that are active. The quantities do not depend on the gauge: poles'
polynomial, gain, static characteristic and step response. Printed for every case: the smallest, mean and largest share
of intervals that contain the truth, and the ratio of printed to true scatter. A share over 300 runs has a standard
error of 1.3 points.
"""

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
from montecarlo import coverage, mapped
from scipy.signal import lfilter

import optid
from optid.errors import OptidError
from optid.identify.uncertainty import uncertainty

NODES = np.linspace(-1, 1, 7)
CURVE = np.array([-1.0, -0.9, -0.5, 0.0, 0.2, 0.7, 1.1])  # f at the nodes
FIRST, SECOND = ((0.0, 0.1), (1.0, -0.9)), ((0.0, 1.0, 0.4), (1.0, -1.3, 0.5))
RESPONSE = ((0.0, 1.0, 0.6, 0.2), (1.0,))
LEVELS, INSTANTS = np.array([-0.9, -0.4, 0.3, 0.9]), np.array([2, 5, 10, 30])
SAMPLES, REST = 700, 100  # samples of a record, and before it
BASIS = optid.Triangular(6, interval=(-1, 1))


@dataclass(frozen=True)
class Case:
    """One kind of records and its fit.

    Attributes:
        formulation, arguments: of the fit; the basis is that of the plant, unless it is linear.
        plant: B and A of the linear part.
        noise: pole of the noise at the output.
        equation: whether its poles are those of the plant instead.
        input: "white" or "coloured".
        ratios: signal-to-noise ratio (of variances) of every experiment.
        missing: share of the outputs.
    """

    formulation: str
    arguments: dict[str, Any]
    plant: tuple[tuple[float, ...], tuple[float, ...]] = SECOND
    noise: float = 0.0
    equation: bool = False
    input: str = "white"
    ratios: tuple[float, ...] = (10.0,)
    missing: float = 0.0

    @property
    def curved(self) -> bool:
        """Whether a static function comes first."""
        return self.formulation.startswith("hammerstein")

    def record(self, seed: int) -> optid.Data:
        """Simulate experiments of equal length."""
        rng, us, ys = np.random.default_rng([seed, 5]), [], []
        count = SAMPLES // len(self.ratios)
        for ratio in self.ratios:
            u = rng.uniform(-1, 1, REST + count)
            if self.input == "coloured":
                u = np.clip(lfilter([0.7], [1, -0.9], u), -1, 1)
            x = lfilter(*self.plant, self.f(u))
            poles = self.plant[1] if self.equation else [1, -self.noise]
            e = lfilter([1.0], poles, rng.standard_normal(len(u)))
            y = x + e * np.std(x) / np.std(e) / np.sqrt(ratio)
            y[rng.uniform(size=len(y)) < self.missing] = np.nan
            us.append(u[REST:])
            ys.append(y[REST:])
        return optid.Data(us, ys, 1.0)

    def f(self, u: Any) -> np.ndarray:
        """Static function of the plant."""
        return np.interp(u, NODES, CURVE) if self.curved else np.asarray(u)

    @property
    def truth(self) -> np.ndarray:
        """Values of `quantities`."""
        (b, a), f = self.plant, self.f(LEVELS) - self.f(0.0)
        return np.concatenate([a[1:], f * np.sum(b) / np.sum(a), lfilter(b, a, np.ones(40))[INSTANTS] * f[-1]])


def quantities(model: Any) -> np.ndarray:
    """Denominator, steady outputs against that at zero, and the response to a step from there to the highest level."""
    plant = getattr(model, "plant", model)
    (f,), (b,) = plant.nonlinearities, plant.b
    lags, values = np.arange(40), f(LEVELS) - f(np.zeros(1))
    numerator = np.concatenate([np.zeros(int(plant.nk[0])), b])
    response = lfilter(numerator, np.r_[1.0, plant.a], np.ones(len(lags)))
    return np.concatenate([plant.a, values * b.sum() / (1 + plant.a.sum()), response[INSTANTS] * values[-1]])


def _cases() -> dict[str, Case]:
    curved = {"na": 2, "nb": 2, "nk": 1, "basis": BASIS}
    linear, first = {"na": 2, "nb": 2, "nk": 1}, {"na": 1, "nb": 1, "nk": 1}
    noises, found = {"white": 0.0, "AR(.9)": 0.9}, {}
    for word, noise in noises.items():
        for kind in ("white", "coloured"):
            ends = f"{word} noise, {kind} input"
            found |= {f"output errors, {ends}": Case("oe.exact", linear, SECOND, noise, input=kind),
                      f"ARMAX, {ends}": Case("armax.exact", first | {"nc": 1}, FIRST, noise, input=kind),
                      f"Box-Jenkins, {ends}": Case("bj.exact", linear | {"nc": 0, "nd": 1}, SECOND, noise, input=kind)}
        ends = f"{word} noise"
        found |= {
            f"Hammerstein output errors, {ends}": Case("hammerstein_oe.exact", curved, noise=noise),
            f"state space, {ends}": Case("ss.exact", {"nx": 2, "feedthrough": False}, noise=noise),
            f"three experiments, {ends}": Case("oe.exact", linear, noise=noise, ratios=(100.0, 10.0, 1.0)),
            f"three experiments, state space, {ends}": Case(
                "ss.exact", {"nx": 2, "feedthrough": False}, noise=noise, ratios=(100.0, 10.0, 1.0)),
            f"missing outputs, {ends}": Case("hammerstein_oe.exact", curved, noise=noise, missing=0.1),
            f"missing outputs, Box-Jenkins, {ends}": Case("bj.exact", linear | {"nc": 0, "nd": 1}, noise=noise,
                                                          missing=0.1),
            f"monotone, {ends}": Case("hammerstein_oe.exact", curved | {"constraints": ["monotone:increasing"]},
                                      noise=noise),
            f"gain, {ends}": Case("oe.exact", linear | {"constraints": ["gain:7"]}, noise=noise),
        }
    found["step band, finite response"] = Case("hammerstein_arx.exact", {
        "na": 0, "nb": 3, "nk": 1, "basis": BASIS, "constraints": ["step_band:0,3.8"]}, RESPONSE, equation=True)
    found["three experiments, arx"] = Case("arx", linear, equation=True, ratios=(100.0, 10.0, 1.0))
    found["Box-Jenkins, noise model too small"] = Case("bj.exact", linear | {"nc": 0, "nd": 0}, noise=0.9)
    return found


CASES = _cases()


def run(job: tuple[str, int]) -> tuple[np.ndarray, ...]:
    """Return estimates, their standard errors, and which intervals contain the truth."""
    name, seed = job
    case = CASES[name]
    try:
        fit = optid.fit(case.record(seed), case.formulation, prove=False, **case.arguments)
        found = uncertainty(fit, seed=seed).of(of_states if case.formulation == "ss.exact" else quantities)
    except OptidError:  # a descent that did not end has no intervals
        return (np.full(case.truth.shape, np.nan),) * 3
    truth, rounding = case.truth, 1e-6 * (1 + np.abs(case.truth))  # a constraint holds a quantity at its bound
    return found.value, found.error, (found.lower - rounding <= truth) & (truth <= found.upper + rounding)


def of_states(model: Any) -> np.ndarray:
    """The same quantities of a linear state-space model."""
    response = np.cumsum(model.impulse_response(40)[:, 0, 0])
    gain = float(np.squeeze(model.static_gain(np.zeros(1))))
    return np.concatenate([np.poly(model.A)[1:], LEVELS * gain, response[INSTANTS] * LEVELS[-1]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cases", nargs="+", default=[""], help="words of the names of cases")
    options = parser.parse_args()
    print(f"{options.runs} records of {SAMPLES} samples a case\n"
          f"{'':<46}{'least':>9}{'mean':>9}{'most':>9}{'printed / true scatter':>26}")
    for name in CASES:
        if any(word in name for word in options.cases):
            jobs = [(name, seed) for seed in range(options.runs)]
            values, errors, covered = map(np.array, zip(*mapped(run, jobs, options.workers)))
            there = np.isfinite(values).all(axis=1)
            share, ratio = coverage(values[there], errors[there], covered[there])
            print(f"{name:<46}{share.min():>7.1f} %{share.mean():>7.1f} %{share.max():>7.1f} %"
                  f"{np.nanmin(ratio):>17.2f} to {np.nanmax(ratio):.2f}"
                  f"{'' if there.all() else f', {np.sum(~there)} without intervals'}", flush=True)


if __name__ == "__main__":
    main()
