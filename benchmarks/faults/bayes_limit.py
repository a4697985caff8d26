"""How many faults can any rule name rightly? The limit, and how near the rules of optid come to it.

The trial is that of isolation.py: a window of 200 samples of the standard plant with one fault of deflection d, one of
six places with equal probability, a jump of the state in a random direction, other faults with a random sign, the onset
uniform from 60 to 139. The rule that names most of these faults rightly is that of Bayes: the place of the largest
posterior, told all of that, deflection and range of the onsets included, which no rule of optid is told. The rate of
any rule is the mean over the windows of the true posterior of the name it chooses; this scatters less than the share of
right names, which is printed beside it.

The limit is computed from the matrices of the plant alone: Riccati equation, predictor, signatures and likelihoods are
written out here (the largest difference from the signatures of optid is printed). In whitened innovations the noise is
N(0, I), so that no record has to be simulated. The rules of optid judge the same windows: the posterior by which
`diagnose` ranks its answers, and the largest energy explained less the threshold of a false alarm of 1 %. Windows
without an alarm of that search are left out, as there.

    python benchmarks/faults/bayes_limit.py [--trials 8000] [--levels 7 10 20]
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from plants import PLANT, cut, standard_plant, windows
from scipy.linalg import solve_discrete_are
from scipy.special import i1e, logsumexp

from optid.faults import dictionary, scan, thresholds
from optid.faults.diagnosis.posterior import single

WINDOW = 200
ONSETS = 60, 140
GOALS = {7: 0.83, 10: 0.93, 20: 0.99}
BATCH = 1000
RULES = "limit: Bayes, told d and range of onsets", "posterior, as diagnose ranks", "energy less threshold"


def signatures(path: Path) -> list[np.ndarray]:
    """Return orthonormal signatures (onsets, N l, d) of two actuators, two sensors, a load and the state."""
    content = json.loads(Path(path).read_text())
    A, B, C, D, E, Q, R = (np.array(content[name], dtype=float) for name in "ABCDEQR")
    n, m, p = len(A), B.shape[1], len(C)
    P = solve_discrete_are(A.T, C.T, Q, R)
    innovation = C @ P @ C.T + R
    K = A @ P @ C.T @ np.linalg.inv(innovation)
    whitening = np.linalg.inv(np.linalg.cholesky(innovation))
    places = [(B[:, [i]], D[:, [i]], True) for i in range(m)]
    places += [(np.zeros((n, 1)), np.eye(p)[:, [o]], True) for o in range(p)]
    places += [(E[:, [0]], np.zeros((p, 1)), True), (np.eye(n), np.zeros((p, n)), False)]
    found = []
    for into_state, into_output, lasts in places:
        d = into_state.shape[1]
        course, error = np.zeros((WINDOW, p, d)), into_state  # the state at the onset is hit already
        for k in range(WINDOW):
            surprise = C @ error + into_output
            course[k] = whitening @ surprise
            error = A @ error - K @ surprise + into_state * lasts
        banks = []
        for onset in range(*ONSETS):
            trace = np.zeros((WINDOW, p, d))
            trace[onset:] = course[: WINDOW - onset]
            banks.append(np.linalg.qr(trace.reshape(WINDOW * p, d))[0])
        found.append(np.array(banks))
    return found


def logs(energies: np.ndarray, dimension: int, d: float) -> np.ndarray:
    """Return the likelihood beside health, averaged over all directions of a signature of deflection d."""
    x = d * np.sqrt(energies)
    if dimension == 1:
        return np.logaddexp(x, -x) - np.log(2) - d * d / 2
    if dimension != 4:
        raise ValueError("only faults of one or of four magnitudes are written out here")
    return np.log(2 * i1e(x) / x) + x - d * d / 2


def share(values: np.ndarray) -> str:
    """Say a mean with its interval of 95 %."""
    return f"{values.mean():.4f} +- {1.96 * values.std() / np.sqrt(values.size):.4f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=8000, help="windows per deflection")
    parser.add_argument("--levels", type=float, nargs="+", default=[7, 10, 20], help="deflections")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    limits = thresholds(found, WINDOW, draws=50_000)
    banks = signatures(options.plant)
    blank = cut(next(windows(model, [()], WINDOW)).whitened, 0)
    search = scan(found, blank)
    off = 0.0
    for label, bank in zip(found.labels, banks):
        for onset in range(ONSETS[0], ONSETS[1], 13):
            own = np.linalg.qr(search.signature(label, onset).reshape(bank[0].shape))[0]
            other = bank[onset - ONSETS[0]]
            off = max(off, float(np.abs(own @ own.T - other @ other.T).max()))
    print(f"{', '.join(found.labels)}\nsignatures of optid differ by at most {off:.1e} from those written out here\n")
    for d in options.levels:
        rng = np.random.default_rng([int(10 * d), 55])
        found_by: dict[str, list[tuple[float, bool]]] = {word: [] for word in RULES}
        for done in range(0, options.trials, BATCH):
            count = min(BATCH, options.trials - done)
            truth, onsets = rng.integers(len(banks), size=count), rng.integers(*ONSETS, size=count)
            r = rng.standard_normal((count, WINDOW * model.l))
            for i, (c, onset) in enumerate(zip(truth, onsets)):
                direction = rng.standard_normal(banks[c].shape[2])
                r[i] += d * banks[c][onset - ONSETS[0]] @ (direction / np.linalg.norm(direction))
            evidence = np.empty((count, len(banks)))
            for c, bank in enumerate(banks):
                flat = np.moveaxis(bank, 1, 0).reshape(r.shape[1], -1)
                energies = np.sum((r @ flat).reshape(count, len(bank), -1) ** 2, axis=2)
                evidence[:, c] = logsumexp(logs(energies, bank.shape[2], d), axis=1)
            probable = np.exp(evidence - logsumexp(evidence, axis=1, keepdims=True))
            for i in range(count):
                window = replace(blank, r=r[i].reshape(WINDOW, -1))
                correlations = search.sweep.correlations(window.r)
                here = replace(search, whitened=window, correlations=correlations,
                               statistic=search.sweep.statistic(correlations))
                gains = here.gains(limits)
                if np.nanmax(gains) <= 0:
                    continue
                explanations = [single(here, candidate) for candidate in found.candidates]
                evidences = [-np.inf if e is None else e.log_evidence for e in explanations]
                names = np.argmax(probable[i]), np.argmax(evidences), np.argmax(np.nanmax(gains, axis=1))
                for word, name in zip(RULES, names):
                    found_by[word].append((probable[i, name], bool(name == truth[i])))
        goal = GOALS.get(int(d))
        detected = len(found_by[RULES[0]]) / options.trials
        print(f"deflection {d:g}: {options.trials} windows, detected {detected:.4f}; named rightly of those"
              + (f"   (goal {goal})" if goal else "") + f"\n  {'':<42}{'mean posterior':<22}counted")
        for word, values in found_by.items():
            expected, right = np.array(values, dtype=float).T
            print(f"  {word:<42}{share(expected):<22}{share(right)}", flush=True)
        print()


if __name__ == "__main__":
    main()
