"""Process models in continuous time: efficiency, coverage, proofs, times, order, beside curve_fit with other tools.

Monte Carlo over simulated step tests and other experiments, with seeds fixed beforehand: root mean square errors over
the bound of Cramér and Rao, coverage of the 95 % intervals; the same errors by brute force, which no fit can better;
random step tests with proofs; times; types by BIC. Run ``python benchmarks/process.py``; smaller with --runs, parts by
name (``cases floor proofs times peers order``).
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import warnings
from time import process_time

import numpy as np
from scipy.optimize import curve_fit
from scipy.signal import lsim

import optid
from optid.identify.process.order import choose_type
from optid.identify.process.proof import BranchAndBound
from optid.identify.process.record import process_errors
from optid.identify.process.starts import usual_box
from optid.models.process import process_model

T = np.arange(200.0)
STEP, PULSE = np.where(T >= 10, 1.0, 0.0), ((T >= 10) & (T < 60)) * 1.0
LEVELS = np.repeat(np.random.default_rng(5).permutation(np.linspace(-1, 1, 16)), 50)

CASES = {  # type, gain, parameters, input, noise as shares of the change of the output
    "step": ("P1D", 2.0, {"tau": 30.0, "dead_time": 12.4}, STEP, (0.01, 0.02, 0.05)),
    "ends after one tau": ("P1D", 2.0, {"tau": 80.0, "dead_time": 5.3}, STEP[:95], (0.02,)),
    "overdamped": ("P2D", 2.0, {"tau1": 30.0, "tau2": 8.0, "dead_time": 12.4}, STEP, (0.02,)),
    "underdamped": ("P2DU", 2.0, {"T": 8.0, "zeta": 0.3, "dead_time": 12.4}, STEP, (0.02,)),
    "integrator": ("P0DI", 0.05, {"dead_time": 12.4}, PULSE, (0.02,)),
    "integrator with lag": ("P1DI", 0.05, {"tau": 9.0, "dead_time": 12.4}, PULSE, (0.02,)),
    "inverse response": ("P2DZ", 2.0, {"tau1": 30.0, "tau2": 12.0, "tau_zero": -10.0, "dead_time": 6.4}, STEP, (0.02,)),
    "PRBS": ("P1D", 2.0, {"tau": 30.0, "dead_time": 12.4}, "prbs", (0.02,)),
    "jitter and gaps": ("P1D", 2.0, {"tau": 30.0, "dead_time": 12.4}, "jitter", (0.02,)),
    "saturating valve": ("P1D", 2.0, {"tau": 30.0, "dead_time": 12.4}, "saturation", (0.02,)),
    "valve with dead zone": ("P1D", 2.0, {"tau": 30.0, "dead_time": 12.4}, "dead zone", (0.02,)),
    "dead time zero": ("P1D", 2.0, {"tau": 30.0, "dead_time": 0.0}, STEP, (0.02,)),
}


def draw(name, seed, noise):
    """A record of a case: (data, options of the fit, truth, Cramér-Rao bounds of its parameters or NaN)."""
    process, gain, parameters, u, _ = CASES[name]
    rng = np.random.default_rng([seed, 17])
    truth, options, curve, keep = process_model(process, K=gain, level=5.0, **parameters), {}, None, None
    times = None
    if isinstance(u, str):
        kind, u = u, STEP
        if kind == "prbs":
            u = np.repeat(rng.integers(0, 2, 20) * 1.0, 10)
            u[:20] = np.repeat([0.0, 1.0], 10)
        elif kind == "jitter":
            times = T + np.concatenate([[0.0], rng.uniform(-0.2, 0.2, 199)])
            u = np.where(times >= 9.7, 1.0, 0.0)
            keep = rng.random(200) > 0.1
            keep[40:55] = keep[90:120] = False
        else:
            u, options = LEVELS, {"basis": "triangular:8"}
            curve = np.clip(u, -0.5, 0.5) if kind == "saturation" else np.sign(u) * np.maximum(np.abs(u) - 0.25, 0)
    t = np.arange(float(len(u))) if times is None else times
    clean = truth.respond((u if curve is None else curve)[:, None], instants=t)
    sigma = noise * (2.0 if gain == 2.0 else np.ptp(clean))
    y = clean + sigma * rng.normal(size=len(u))
    if keep is not None:
        y[~keep] = np.nan
    return optid.Data(u, y, times=times), options, truth, bounds(truth, u, t, np.isfinite(y), sigma, curve)


def bounds(truth, u, t, keep, sigma, curve):
    """Cramér-Rao bounds (K and parameters) of a linear process, or with a free static curve at its nodes."""
    one, gain = truth.processes[0], truth.nonlinearities[0].mu[0]
    f = u if curve is None else curve
    moved = one.response(t, t, (f - f[0])[:, None], sensitive=True)[:, :, 0]
    static = 0.0 if one.structure.integrator else f[0]
    linear = [moved[:, 0] + static]
    if curve is not None:
        nodes = np.linspace(-1, 1, 9)
        hats = np.array([np.interp(u, nodes, row) for row in np.eye(9)[1:]]).T
        linear = [one.response(t, t, (h - h[0])[:, None])[:, 0, 0] + h[0] for h in hats.T]
    slopes = np.column_stack([*linear, gain * moved[:, 1:], np.ones(len(t))])[keep]
    sizes = np.linalg.norm(slopes, axis=0)
    error = sigma * np.sqrt(np.diag(np.linalg.pinv((slopes / sizes).T @ (slopes / sizes)))) / sizes
    return error[(0 if curve is None else len(linear)) : -1]


def cases(runs, only):
    """Print efficiency and coverage of every case."""
    print(f"{'case':28s} {'noise':>6s}  parameter: RMSE over Cramér-Rao, coverage of 95 % ({runs} runs)")
    for name, (_, gain, parameters, _, noises) in CASES.items():
        for noise in noises:
            if only and only not in name:
                continue
            rows, seconds = [], 0.0
            for seed in range(runs):
                data, options, truth, bound = draw(name, seed, noise)
                begun = process_time()
                found = optid.fit(data, "process.exact", process=CASES[name][0], prove=False, **options)
                table = {row.name: row for row in found.params}
                seconds += process_time() - begun
                values = {**({"K": gain} if "basis" not in options else {}), **parameters}
                rows.append([(table[key].estimate - value, table[key].lower <= value <= table[key].upper, crb)
                             for (key, value), crb in zip(values.items(), bound)])
            found = np.array(rows, dtype=float)
            words = [f"{key} {np.sqrt(np.mean(e**2) / np.mean(c**2)):.2f} {100 * np.mean(hit):.1f} %"
                     for key, (e, hit, c) in zip(values, found.transpose(1, 2, 0))]
            print(f"{name:28s} {100 * noise:4.0f} %  {'; '.join(words)}  ({1e3 * seconds / runs:.0f} CPU ms)",
                  flush=True)


def proofs(runs):
    """Print how many random step tests are proved, how often a fit was already there, and times."""
    for process, most, count in (("P1D", 400, runs), ("P2D", 200, min(runs, 25))):
        proved, seconds, gaps = 0, [], []
        for seed in range(count):
            rng = np.random.default_rng([seed, 3])
            size = int(rng.integers(60, most))
            t, on = np.arange(float(size)), int(rng.integers(3, size // 4))
            tau = np.exp(rng.uniform(np.log(2), np.log(size / 2)))
            dead_time, noise = rng.uniform(0, size / 4), 2 * np.exp(rng.uniform(np.log(0.01), np.log(0.2)))
            taus = {"tau": tau} if process == "P1D" else {"tau1": tau, "tau2": tau * rng.uniform(0.1, 0.6)}
            truth = process_model(process, K=2.0, level=5.0, dead_time=dead_time, **taus)
            u = np.where(t >= on, 1.0, 0.0)
            data = optid.Data(u, truth.respond(u[:, None]) + noise * rng.normal(size=size))
            found = optid.fit(data, "process.exact", process=process)
            begun = process_time()
            proved += found.solution.proof
            seconds.append(process_time() - begun)
            gaps.append(found.solution.gap)
        print(f"random step tests of {process}, noise 1 to 20 %: {proved} of {count} proved, largest gap "
              f"{max(gaps):.1e}, a proof {np.median(seconds):.3f} CPU s (median), {max(seconds):.2f} CPU s (longest)",
              flush=True)
    stairs = np.repeat(np.random.default_rng(5).normal(size=20), 20)
    for name, u in {"step, 200 samples": STEP, "step, 2,000 samples": np.where(np.arange(2000) >= 10, 1.0, 0.0),
                    "staircase of 20 moves, 400 samples": stairs}.items():
        times = []
        for seed in range(5):
            truth = process_model("P1D", K=2.0, tau=30.0, dead_time=12.4, level=5.0)
            y = truth.respond(u[:, None]) + 0.1 * np.random.default_rng(seed).normal(size=len(u))
            found = optid.fit(optid.Data(u, y), "process.exact", process="P1D")
            begun = process_time()
            assert found.solution.proof
            times.append(process_time() - begun)
        print(f"proof, {name}: {np.median(times):.3f} CPU s (median of 5)")


def times():
    """Print times of fits."""
    for count in (200, 10_000, 100_000):
        truth = process_model("P1D", K=2.0, tau=count / 8, dead_time=count / 20 + 0.4, level=5.0)
        rng, t = np.random.default_rng(1), np.arange(float(count))
        inputs = {"step": np.where(t >= count // 10, 1.0, 0.0),
                  "50 moves": np.repeat(rng.normal(size=51), count // 50)[:count]}
        for name, u in inputs.items():
            for jitter in (False, True):
                at = t + jitter * np.concatenate([[0.0], rng.uniform(-0.2, 0.2, count - 1)])
                y = truth.respond(u[:, None], instants=at) + 0.1 * rng.normal(size=count)
                data, best = optid.Data(u, y, times=at if jitter else None), np.inf
                for _ in range(3):
                    begun = process_time()
                    optid.fit(data, "process.exact", process="P1D", prove=False)
                    best = min(best, process_time() - begun)
                print(f"fit, {count:7,d} samples, {'irregular' if jitter else 'regular'}, {name}: {best:.3f} CPU s")


def responses():
    """What people wrap in curve_fit, by name: (t, u, gain, tau, dead time, level) -> output.

    All interpolate the held input, which they delay, between its samples.
    """
    def by_lsim(t, u, gain, tau, theta, level):
        return level + gain * lsim(([1.0], [tau, 1.0]), np.interp(t - theta, t, u, left=0.0), t)[1]

    found = {"curve_fit with lsim": by_lsim}
    try:
        import control
    except ImportError:
        print('python-control is not installed (pip install "optid[control]"): not compared')
        return found

    def by_control(t, u, gain, tau, theta, level):
        delayed = np.interp(t - theta, t, u, left=0.0)
        return level + control.forced_response(control.tf([gain], [tau, 1.0]), t, delayed).outputs

    return {**found, "curve_fit with python-control": by_control}


def peers(runs):
    """Print curve_fit beside the fit: error of the dead time, share at the optimum, times."""
    others = responses()
    errors, at, spent = ({name: start() for name in ("optid", *others)} for start in (list, int, float))
    for seed in range(runs):
        data, _, _, _ = draw("step", seed, 0.02)
        y = data.y[:, 0]
        begun = process_time()
        found = optid.fit(data, "process.exact", process="P1D", prove=False)
        spent["optid"] += process_time() - begun
        errors["optid"].append(found.params["dead_time"].estimate - 12.4)
        at["optid"] += 1
        guess = [y[-20:].mean() - y[:10].mean(), 20.0, 5.0, y[:10].mean()]
        box = [-np.inf, 0.05, 0.0, -np.inf], [np.inf, 2000, 140, np.inf]
        for name, response in others.items():
            begun = process_time()
            try:
                p = curve_fit(lambda t, *p, response=response: response(t, STEP, *p), T, y, guess, bounds=box)[0]
            except RuntimeError:
                p = np.full(4, np.nan)
            spent[name] += process_time() - begun
            errors[name].append(p[2] - 12.4)
            if np.isfinite(p).all():  # its optimum by the exact response
                held = process_model("P1D", K=p[0], tau=p[1], dead_time=p[2], level=p[3]).respond(STEP[:, None])
                at[name] += np.sum((y - held) ** 2) <= found.solution.objective * 1.001
    for name in errors:
        size = np.sqrt(np.nanmean(np.square(errors[name])))
        print(f"{name:30s} RMSE of the dead time {size:.3f}, bias {np.nanmean(errors[name]):+.3f}, within 0.1 % of the "
              f"optimum {100 * at[name] / runs:.0f} %, {1e3 * spent[name] / runs:.0f} CPU ms a fit")
    count = 10_000
    t, truth = np.arange(float(count)), process_model("P1D", K=2.0, tau=1250.0, dead_time=500.4, level=5.0)
    u = np.where(t >= 1000, 1.0, 0.0)
    y = truth.respond(u[:, None]) + 0.1 * np.random.default_rng(0).normal(size=count)
    optid.fit(optid.Data(u, y), "process.exact", process="P1D", prove=False)
    begun = process_time()
    optid.fit(optid.Data(u, y), "process.exact", process="P1D", prove=False)
    ours = process_time() - begun
    for name, response in others.items():
        begun = process_time()
        curve_fit(lambda t, *p, response=response: response(t, u, *p), t, y, [1.5, 1000.0, 300.0, 5.0])
        took = process_time() - begun
        print(f"N = 10,000: optid {ours:.3f} CPU s, {name} {took:.3f} CPU s, {took / ours:.0f} times as long")


def brute_force(y, on=10):
    """Best (tau, dead time) of steps at a sample for records (200, R), by a grid that is refined three times."""
    def columns(tau, theta):
        x = -np.expm1(-np.maximum(T - on - theta[:, None], 0) / tau[:, None])
        x -= x.mean(axis=1, keepdims=True)
        return x / np.linalg.norm(x, axis=1, keepdims=True)

    taus, thetas = (g.ravel() for g in np.meshgrid(np.exp(np.arange(np.log(4), np.log(300), 0.02)),
                                                   np.arange(0, 45, 0.1)))
    best, explained = np.zeros(y.shape[1], dtype=int), np.full(y.shape[1], -1.0)
    for first in range(0, len(taus), 20_000):
        part = slice(first, first + 20_000)
        found = (columns(taus[part], thetas[part]) @ y) ** 2
        i = found.argmax(axis=0)
        value = found[i, np.arange(y.shape[1])]
        best, explained = np.where(value > explained, i + first, best), np.maximum(value, explained)
    ends = np.column_stack([taus[best], thetas[best]])
    for k, (tau, theta) in enumerate(ends):
        for width in (1.0, 0.1, 0.01):
            near = [g.ravel() for g in np.meshgrid(tau * np.exp(width * np.linspace(-0.04, 0.04, 33)),
                                                   np.clip(theta + width * np.linspace(-0.4, 0.4, 33), 0, None))]
            i = int(((columns(*near) @ y[:, k]) ** 2).argmax())
            tau, theta = near[0][i], near[1][i]
        ends[k] = tau, theta
    return ends


def floor(runs):
    """Print the efficiency of maximum likelihood by brute force on the step tests of the cases."""
    for noise in CASES["step"][-1]:
        drawn = [draw("step", seed, noise) for seed in range(runs)]
        ends = brute_force(np.column_stack([data.y[:, 0] for data, *_ in drawn]))
        crb = np.mean(np.square([bound[1:3] for *_, bound in drawn]), axis=0)
        tau, theta = np.sqrt(np.mean((ends - [30.0, 12.4]) ** 2, axis=0) / crb)
        print(f"maximum likelihood by brute force, step, {100 * noise:.0f} %: RMSE over Cramér-Rao tau {tau:.2f}; "
              f"dead_time {theta:.2f} ({runs} runs)")


def order(runs):
    """Print how often BIC chooses the true type."""
    types = {"P1": {"tau": 30.0}, "P1D": {"tau": 30.0, "dead_time": 12.4},
             "P2D": {"tau1": 30.0, "tau2": 8.0, "dead_time": 12.4}, "P2DU": {"T": 8.0, "zeta": 0.4, "dead_time": 12.4},
             "P2DZ": {"tau1": 30.0, "tau2": 12.0, "tau_zero": -10.0, "dead_time": 6.4}, "P0DI": {"dead_time": 12.4},
             "P1DI": {"tau": 9.0, "dead_time": 12.4},
             "P3D": {"tau1": 20.0, "tau2": 10.0, "tau3": 10.0, "dead_time": 5.4}}
    right = tried = 0
    for word, parameters in types.items():
        u, chosen, open_ = PULSE if "I" in word else STEP, {}, 0
        for seed in range(runs):
            clean = process_model(word, K=2.0, level=5.0, **parameters).respond(u[:, None])
            y = clean + 0.02 * np.ptp(clean) * np.random.default_rng([seed, 9]).normal(size=200)
            structure, said = choose_type(process_errors(optid.Data(u, y), "P1D", "linear"))
            name = structure.word
            chosen[name], open_ = chosen.get(name, 0) + 1, open_ + ("not dis" in said)
        right, tried = right + (word != "P3D") * chosen.get(word, 0), tried + (word != "P3D") * runs
        print(f"type {word}: {chosen}, {open_} not distinguishable from the runner-up", flush=True)
    print(f"type by BIC, one step or pulse, 2 % noise, without P3D: {right} of {tried}")


def main():
    """Run the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("parts", nargs="*", default=[], help="cases, floor, proofs, times, peers, order")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--case", default="", help="part of the name of a case")
    given = parser.parse_args()
    parts = given.parts or ["cases", "floor", "proofs", "times", "peers", "order"]
    warnings.simplefilter("ignore")
    data = draw("step", 0, 0.02)[0]
    _ = optid.fit(data, "process.exact", process="P1D").params  # compiled
    errors = process_errors(data, "P1D", "linear")
    BranchAndBound(errors, usual_box(errors)).search(np.inf, 0.1, 1.0)
    if "cases" in parts:
        cases(given.runs, given.case)
    if "floor" in parts:
        floor(given.runs)
    if "proofs" in parts:
        proofs(min(given.runs, 150))
    if "times" in parts:
        times()
    if "peers" in parts:
        peers(min(given.runs, 100))
    if "order" in parts:
        order(min(given.runs, 50))


if __name__ == "__main__":
    main()
