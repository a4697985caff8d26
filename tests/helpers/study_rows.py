"""Synthetic rows of a study, for the tests of whatever reads them."""

import hashlib
import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from optid.studies.storage.rows import as_json, complete
from optid.studies.storage.store import Store

START = datetime(2026, 3, 1, 8, 0, tzinfo=UTC)
# solver: (factor of its time, share of runs that fail, share of false claims, exponent of the growth with N)
SOLVERS = {"clarabel": (1.0, 0.0, 0.0, 1.0), "scs": (4.0, 0.05, 0.03, 1.1), "osqp": (0.6, 0.10, 0.06, 1.0),
           "ipopt": (2.5, 0.03, 0.0, 1.3), "gauss_newton": (0.2, 0.01, 0.0, 0.9), "uno": (9.0, 0.12, 0.02, 1.8)}
FORMULATIONS = {"exact": ("hammerstein_arx.exact", "NLP", 0.0), "relaxed": ("hammerstein_arx.nuclear", "SDP", -1.5),
                "linear": ("arx", "QP", -9.0)}  # name, class, loss of fit in points
DATA = {"dead zone": ("dead_zone", 78.0), "thruster": ("thruster", 84.0), "two tanks": ("", 71.0),
        "heater": ("", 90.0)}  # system ("" for a file), one-step fit
SAMPLES = (200, 1000, 5000)
VERSIONS = {"optid": "0.1.0", "numpy": "2.2.0", "scipy": "1.15.0", "cvxpy": "1.9.3"}


def rows(count: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return ``count`` complete rows of one study over solvers, formulations, data, lengths and seeds.

    Like real ones they hold failures, limits, crashes, refusals, non-finite answers and false claims.
    """
    rng = np.random.default_rng(seed)
    grid = [(d, f, s, n) for d in DATA for n in (SAMPLES if DATA[d][0] else (None,)) for f in FORMULATIONS
            for s in SOLVERS]
    made = []
    for k in range(count):
        data, formulation, solver, samples = grid[k % len(grid)]
        made.append(_row(rng, k, k // len(grid), data, formulation, solver, samples))
    return made


def _row(rng: np.random.Generator, k: int, turn: int, data: str, formulation: str, solver: str, samples: int | None
         ) -> dict[str, Any]:
    name, kind, loss = FORMULATIONS[formulation]
    system, level = DATA[data]
    factor, failing, lying, growth = SOLVERS[solver]
    noise, seed, repetition = (0.1, turn, 0) if system else (None, None, turn)
    labels = ("synthetic", data, formulation, solver, samples, noise, seed, 1e-8, repetition)
    row: dict[str, Any] = dict(
        key=f"{place(*labels[:-1]):0<64}", repetition=repetition, study="synthetic", data=data,
        formulation=formulation, solver=solver, system=system or None, file=None if system else f"{data}.csv",
        data_hash=None if system else place(data),
        samples=samples, noise=noise, seed=seed, formulation_name=name, options=as_json({"na": 2, "nb": 2}),
        constraints="[]", solver_name=solver, solver_options="{}", accuracy=1e-8, warm=True, holdout=0.3,
        time_limit=60.0, memory_limit=2000.0, n_samples=samples or 1500, n_estimation=int(0.7 * (samples or 1500)),
        n_inputs=1, n_outputs=1, started=(START + timedelta(seconds=k)).isoformat(), machine="synthetic, 2 cores",
        versions=as_json({**VERSIONS, solver: "1.0"}))
    refused = (kind == "NLP" and solver in ("clarabel", "scs", "osqp")) or (kind == "SDP" and solver in (
        "osqp", "ipopt", "gauss_newton", "uno")) or (kind == "QP" and solver == "gauss_newton")
    if refused:
        return complete({**row, "outcome": "refused", "reason": f"{solver} does not solve programmes of class {kind}",
                         "total_s": 0.001})
    seconds = 0.01 * factor * (row["n_samples"] / 1000) ** growth * float(np.exp(0.3 * rng.standard_normal()))
    fate = rng.random()
    if fate < 0.01:
        return complete({**row, "outcome": "crashed", "reason": "the worker died: signal SIGSEGV", "total_s": seconds})
    if fate < 0.025:
        return complete({**row, "outcome": "time limit", "reason": "stopped after 60.5 s", "total_s": 60.5})
    if fate < 0.03:
        return complete({**row, "outcome": "memory limit", "reason": "held 2104 MB", "total_s": 3.0, "peak_mb": 2104.0})
    if fate < 0.035:
        return complete({**row, "outcome": "non-finite", "reason": "the solver returned non-finite numbers",
                         "status_claimed": "optimal", "status_verified": "failed", "false_claim": True,
                         "total_s": seconds})
    best = 2.0 * (1.0 + 0.1 * (hash_of(data, samples, seed) % 10)) * (1.0 - 0.02 * loss)
    row |= dict(outcome="done", program_class=kind, unknowns=24, n_programs=1, scale=100.0, load_s=0.002,
                build_s=0.2 * seconds, compile_s=0.1 * seconds, solve_s=seconds, judge_s=1e-4, prove_s=1e-3,
                fit_s=1.4 * seconds, warm_s=0.5 * seconds, warm_iterations=5, warm_status="locally optimal",
                total_s=1.5 * seconds, peak_mb=210.0 + 40.0 * rng.random(), base_mb=200.0,
                iterations=int(rng.integers(5, 60)))
    if fate < 0.035 + failing:
        return complete({**row, "status_claimed": "solver_error", "status_verified": "failed",
                         "reason": f"{solver} gave up"})
    lies = fate < 0.035 + failing + lying
    proved = not lies and (kind != "NLP" or rng.random() < 0.9)
    error = 10 ** rng.uniform(-3.5, -2.0) if lies else 10 ** rng.uniform(-12, -8.5)
    fit = level + loss + 0.3 * float(rng.standard_normal())
    pole = [0.75 + 0.01 * float(rng.standard_normal()), 0.35]
    status = "inaccurate" if lies else "optimal" if proved else "locally optimal"
    truth = dict(parameter_error=0.03 * float(rng.random()), nonlinearity_error=0.05 * float(rng.random())
                 ) if system else {}
    objective = best * (1.0 + error)
    return complete({
        **row, **truth, "status_claimed": "optimal", "status_verified": status, "reached": not lies, "proved": proved,
        "false_claim": lies, "reason": f"{solver} claims success, but the point is not stationary" if lies else None,
        "objective": objective, "bound": best if proved else None, "gap": error if proved else None,
        "violation": error if lies else 0.0, "stationarity": error, "complementarity": 0.0,
        "one_step_fit": fit, "one_step_fits": as_json([fit]), "simulation_fit": fit - 3.0,
        "simulation_fits": as_json([fit - 3.0]), "parameters": as_json({"a1": -2 * pole[0], "mu[u]": [0.0, 1.0]}),
        "poles": as_json([pole, [pole[0], -pole[1]]]), "stable": True})


def hash_of(*labels: Any) -> int:
    """A number that depends on the labels alone, not on the process."""
    return int(place(*labels)[:8], 16)


# ---- a database


def append(path, made):
    """Append rows to a database, which is made when it is not there."""
    with Store(path, write=True) as store:
        store.append(made)


def finished_rows(path, study=None):
    """(key, repetition) of every row of a database, or of one study; none where there is no database yet."""
    if not Path(path).exists():
        return set()
    with Store(path) as store:
        return store.finished_rows(study)


# ---- rows by hand, for the tests of a verdict


def run(solver, problem=0, data="tank", seconds=1.0, *, formulation="exact", objective: float | None = 1.0, **more):
    """One row: solved unless said otherwise."""
    return {"study": "s", "data": data, "formulation": formulation, "solver": solver, "seed": problem, "samples": 1000,
            "noise": 0.1, "n_samples": 1000, "accuracy": 1e-8, "outcome": "done", "status_claimed": "optimal",
            "status_verified": "optimal", "objective": objective, "scale": 10.0, "solve_s": seconds, "violation": 0.0,
            "stationarity": 1e-10, "time_limit": 60.0, "false_claim": False, "proved": True, **more}  # fmt: skip


def table_of(times, **more):
    """Rows of times (P, S), solvers a, b, ...; NaN fails."""
    return [run("abcdefgh"[s], p, seconds=t, **more) if np.isfinite(t) else
            run("abcdefgh"[s], p, seconds=1.0, status_verified="failed", reason="gave up", **more)
            for p, row in enumerate(times) for s, t in enumerate(row)]  # fmt: skip


def times_of(*factors, problems=20, spread=0.1, seed=0):
    """Times (P, S) of solvers that take so many times a time that differs from problem to problem."""
    rng = np.random.default_rng(seed)
    base = np.exp(rng.normal(size=(problems, 1)))
    return base * np.array(factors) * np.exp(spread * rng.normal(size=(problems, len(factors))))


def share(profile, factor):
    """The share of problems that a performance profile has within a factor of the fastest time."""
    return max(profile[1][profile[0] <= factor], default=0.0)


# ---- complete rows by hand, for the tests of comparisons


def row(solver, **values):
    """One complete row of a comparison on one record: solved unless said otherwise."""
    given = {"key": solver, "repetition": 0, "study": "s", "data": "d", "formulation": "f",
             "solver": solver, "formulation_name": "f", "options": "{}", "constraints": "[]", "solver_name": solver,
             "solver_options": "{}", "accuracy": 1e-8, "holdout": 0.3, "time_limit": 60.0, "memory_limit": 2e3,
             "outcome": "done", "status_verified": "optimal", "proved": True, "reached": True, "objective": 1.0,
             "scale": 10.0, "violation": 1e-12, "stationarity": 1e-12, "solve_s": 0.01,
             "started": "2026-01-01T00:00:00",
             "machine": "m", "versions": "{}", "warm": True, "warm_s": 0.005}
    return complete({**given, **values})


LOCAL = {"status_verified": "locally optimal", "proved": False}
FAILED = {"status_verified": "failed", "reached": False, "proved": False, "objective": None, "reason": "it broke"}


def place(*labels):
    """The hash of labels, in 32 digits."""
    return hashlib.sha256(json.dumps(labels).encode()).hexdigest()[:32]
