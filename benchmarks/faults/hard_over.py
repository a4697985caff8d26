"""Hard-over losses by rank deficiency: the decision table of chapter 7, statistics, delays, and what must stay silent.

Two plants of order 4 (two modes, apart or coupled; N = 1500, measurement noise 0.1, process noise 0 or 0.1, white
inputs) and the standard plant of OPTID_DATA/fault_plant.json (levels held 5 samples). Printed beside their goals:
orders 4 / 2 / 2 apart and 4 / 4 / 4 coupled, the actuator hidden behind past outputs where there is process noise; dead
rows and columns at or below their threshold (0.5 - 1.4 and 0.14 - 0.80 of the i.i.d. 0.1 % one in the source), live
ones above 200 and 520 times; order 4 of a window with the failure in its middle; delay of a sliding window about its
length; no verdict where the inputs stand still. Losses of 30 % are shown as they are: rank does not see them.

    python benchmarks/faults/hard_over.py [--runs 40]
"""

import argparse
import warnings

import numpy as np
from plants import PLANT, standard_plant
from scipy.stats import chi2

import optid
from optid import Data
from optid.faults import Fault, HardOver, hard_over_test, inject
from optid.faults.hard_over import BLOCK_ROWS
from optid.plants import two_mode_plant

N = 1500
FAULTS = (None, "sensor:y1", "actuator:u1")
ORDERS = {False: (4, 2, 2), True: (4, 4, 4)}


def judged(plant: optid.HammersteinSS, fault: Fault | None, seed: int, n: int = N, hold: int = 1, size: float = 1.0,
           **settings) -> HardOver:
    """Simulate a healthy record and another one with the fault, and test the second."""
    rng = np.random.default_rng(seed)
    draw = rng.normal if hold == 1 else lambda size: rng.uniform(-1.2, 1.2, size)
    u = np.repeat(draw(size=((n + 2 * N) // hold, 2)), hold, axis=0)
    u[2 * N :] *= size
    y = inject(plant, u, [] if fault is None else [fault], seed=seed)
    return hard_over_test(Data(u[2 * N :], y[2 * N :]), Data(u[: 2 * N], y[: 2 * N]), window=N, **settings)


def lost(name: str | None, onset: int = 0, share: float = 1.0) -> Fault | None:
    """Fault of a record whose first 2 N samples are the healthy ones."""
    return None if name is None else Fault.loss(name, 2 * N + onset, share)


def decisions(runs: int) -> None:
    """Orders, rows and columns of whole windows, and of a window with the failure in its middle."""
    j = N - 3 * BLOCK_ROWS + 1
    iid = {"row": chi2.isf(1e-3, BLOCK_ROWS * 4 * BLOCK_ROWS) / j, "column": chi2.isf(1e-3, 2 * (BLOCK_ROWS + 1)) / j}
    print(f"{runs} runs each. Share of the expected order; statistic of the lost channel over its threshold (and over "
          "the i.i.d. one);\nsmallest of the others; share of runs with an alarm that names the lost channel, and that "
          "name it alone\n")
    print(f"{'plant':<10}{'noise':>5} {'failure':<12}{'order':>6}{'share':>7}{'past':>6}{'middle':>8}"
          f"{'dead':>12}{'i.i.d.':>12}{'live':>7}{'named':>7}{'alone':>7}")
    for coupled, noise, (fault, order) in ((c, w, pair) for c in (False, True) for w in (0.0, 0.1)
                                           for pair in zip(FAULTS, ORDERS[c])):
        model = two_mode_plant(coupled, noise)
        found = [judged(model, lost(fault), seed) for seed in range(runs)]
        past = [judged(model, lost(fault), seed, instruments="inputs+past").windows[0].order for seed in range(runs)]
        middle = [judged(model, lost(fault, N // 2), seed).windows[0].order for seed in range(runs)]
        tests = [{t.name: t for t in (*f.windows[0].rows, *f.windows[0].columns)} for f in found]
        live = min(t.ratio for run in tests for t in run.values() if t.name != fault and (coupled or "2" in t.name))
        dead = raw = "-"
        if fault:
            own = [run[fault] for run in tests]
            word = "row" if fault.startswith("sensor") else "column"
            dead = f"{min(t.ratio for t in own):.2f}-{max(t.ratio for t in own):.2f}"
            raw = "-".join(f"{f(t.statistic / iid[word] for t in own):.2f}" for f in (min, max))
        named = np.mean([f.detected if fault is None else fault in f.candidates for f in found])
        alone = np.mean([f.candidates == ((fault,) if fault else ()) for f in found])
        print(f"{'coupled' if coupled else 'apart':<10}{noise:>5} {fault or 'none':<12}{order:>6}"
              f"{np.mean([f.windows[0].order == order for f in found]):>7.2f}{int(np.median(past)):>6}"
              f"{np.mean(np.array(middle) == 4):>8.2f}{dead:>12}{raw:>12}{live:>7.0f}{named:>7.2f}{alone:>7.2f}",
              flush=True)
    print("goal: share 1; past 4 at noise 0.1 behind a lost actuator, else as order; middle 1; dead up to 1;\n"
          "live above 200; named 1 (0 without failure); alone 1 where coupled. Apart, y1 and u1 share all their\n"
          "rank; what y1 still shows of process noise tells a lost actuator. Without process noise past outputs see\n"
          "the state that dies away after the failure: up to 4, falling to 2 with the length of the window.\n")


def streams(model: optid.HammersteinSS, what: str, runs: int, hold: int, expand: bool) -> None:
    """Alarms of sliding windows: delay, isolation, partial losses, standing and weak inputs."""
    settings = {"model": model if expand else None, "hop": N // 10, "n": 4 * N, "hold": hold}
    print(f"{what}, window {N}, hop {N // 10}, failure at sample {N} of {4 * N}\n{'case':<22}{'alarm before':>13}"
          f"{'detected':>10}{'delay mean':>12}{'p95':>7}{'isolated p95':>14}{'right alone':>13}  goal")
    cases = [(f"{c} lost", lost(c, N), 1.0, f"isolated after about {N}, right 1")
             for c in ("sensor:y1", "sensor:y2", "actuator:u1", "actuator:u2")]
    cases += [("actuator:u1 -30 %", lost("actuator:u1", N, 0.3), 1.0, "as it is: no channel is dead"),
              ("healthy", None, 1.0, "no alarm"), ("inputs stand still", None, 0.0, "no alarm"),
              ("u1 lost, no input", lost("actuator:u1", N), 0.0, "no alarm: untestable"),
              ("inputs at 2 %", None, 0.02, "no alarm")]
    for name, fault, size, goal in cases:
        found = [judged(model, fault, seed, size=size, **settings) for seed in range(runs)]
        stops = np.array([f.alarm.stop if f.alarm else np.inf for f in found])
        delays = stops[np.isfinite(stops) & (stops > N)] - N
        early = np.mean(stops <= N)
        named = [f.isolation.stop - N for f in found if f.isolation]
        right = np.mean([bool(fault) and f.candidates == (fault.name,) for f in found])
        mean, p95 = (f"{v:.0f}" if delays.size else "-" for v in (
            (delays.mean(), np.quantile(delays, 0.95)) if delays.size else (0, 0)))
        print(f"{name:<22}{early:>13.2f}{np.mean(np.isfinite(stops)):>10.2f}{mean:>12}{p95:>7}"
              f"{f'{np.quantile(named, 0.95):.0f}' if named else '-':>14}{right:>13.2f}  {goal}",
              flush=True)
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=40)
    runs = parser.parse_args().runs
    warnings.simplefilter("ignore", optid.errors.DataWarning)
    decisions(runs)
    streams(two_mode_plant(True, 0.1), "coupled plant", runs, 1, False)
    if not PLANT.is_file():
        print("The standard plant is left out: OPTID_DATA does not lead to fault_plant.json.")
        return
    streams(standard_plant()[0], "standard plant", runs, 5, True)


if __name__ == "__main__":
    main()
