"""The search for a structure: what one call finds on real records and on simulated plants, and what it costs.

    OPTID_DATA=folder python benchmarks/identify.py [--effort normal] [--only reflex tanks ...] [--oracle]
    python benchmarks/identify.py --plants [kind ...] [--seeds 25] [--jobs 2]
    python benchmarks/identify.py --sums

Real records: the search sees the estimation part alone; the validation part is simulated once, at the end, its initial
state fitted. Printed are the fits in % on the validation part of the choice and of the linear model with the best
cross-validated score, the verdict, and CPU seconds; with --oracle the best validation fit among all structures that the
search has tried on every block, and the regret. Goals: no choice more than 0.5 point below the linear model; a mean
regret of at most 2.5 points; at most 60 CPU s a record of 10,000 samples.

Simulated plants (--plants), ten ordinary kinds and five likenesses of known records (`search_plants.py`): the error of
a free run on fresh inputs against the plant without noise, the fit in % beside that of the plant itself, and the shares
of records whose class is right and whose error is at most 5 %. Goal on ordinary kinds: 90 % have both.

Exact leave-one-block-out statistics (--sums): time of scanning autoregressions of all orders from the sums of one pass,
beside fitting each of them to the record without each block.
"""

import argparse
import os
import resource
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from search_plants import LIKENESSES, ORDINARY, record

import optid
from optid.errors import OptidError
from optid.identify.blocks import Blocks, pooled_fit
from optid.identify.lag_sums import LagSums, scan
from optid.identify.search import identify
from optid.identify.validation.predictions import prediction_fit

NEAR = 0.05  # error of a free run, over the deviation of the output, up to which a model is right
CSV: dict[str, tuple[str, int, float, dict[str, Any]]] = {
    "hair dryer": ("daisy_hairdryer", 700, 0.08, {}),
    "robot arm": ("daisy_robotarm", 716, 1.0, {}),
    "ball and beam": ("daisy_ballbeam", 700, 0.1, {}),
    "gas furnace": ("boxjenkins_gas_furnace", 200, 9.0, {}),
    "heating": ("daisy_heating", 561, 2.0, {}),
    "reflex": ("nlid_reflex", 5000, 0.005, {}),
    "actuator": ("lab_hydraulic_actuator", 512, 1.0, {"inputs": ["u_valve"], "outputs": ["y_pressure"]}),
    "wiener": ("nlid_mod1", 5000, 0.001, {}),
    "cd player": ("daisy_cdplayer", 1500, 1.0, {}),
    "evaporator": ("daisy_evaporator", 5000, 1.0, {}),
    "dryer": ("daisy_dryer_industrial", 600, 10.0, {}),
    "cstr": ("daisy_cstr", 5000, 0.1, {}),
    "damadics": ("damadics_actuator3_onehour", 1800, 1.0,
                 {"inputs": ["CV_pct", "P1_kPa", "P2_kPa"], "outputs": ["X_pct"]}),
}


def records(folder: Path) -> Iterator[tuple[str, Callable[[], tuple[optid.Data, optid.Data]]]]:
    """Yield (name, what returns the parts for estimation and validation)."""
    for name, (file, cut, dt, channels) in CSV.items():
        yield name, lambda file=file, cut=cut, dt=dt, channels=channels: _csv(folder / f"{file}.csv", dt, channels,
                                                                              cut)
    yield "tanks", lambda: _tanks(folder)
    yield "ced", lambda: _ced(folder)
    yield "silverbox", lambda: _silverbox(folder)
    yield "three tanks", lambda: _three_tanks(folder)


def _csv(path: Path, dt: float, channels: dict[str, Any], cut: int) -> tuple[optid.Data, optid.Data]:
    table = np.genfromtxt(path, delimiter=",", names=True)
    names = table.dtype.names or ()
    u, y = (np.column_stack([table[c] for c in channels.get(role, [c for c in names if c.startswith(letter)])])
            for role, letter in (("inputs", "u"), ("outputs", "y")))
    return optid.Data(u, y, dt=dt).split(cut)


def _tanks(folder: Path) -> tuple[optid.Data, optid.Data]:
    table = np.genfromtxt(folder / "nlb_cascaded_tanks.csv", delimiter=",", names=True)
    return tuple(optid.Data(table[f"u_{part}"], table[f"y_{part}"], dt=4.0) for part in ("est", "val"))


def _ced(folder: Path) -> tuple[optid.Data, optid.Data]:
    table = np.genfromtxt(folder / "nlb_ced_prbs.csv", delimiter=",", names=True)
    whole = optid.Data([table[f"u{i}"] for i in (1, 2, 3)], [table[f"z{i}"] for i in (1, 2, 3)], dt=0.02)
    return whole.split(250)


def _silverbox(folder: Path) -> tuple[optid.Data, optid.Data]:
    """Of the multisine the first 8,000 samples to estimate from, and the published test part."""
    with np.load(folder / "nlb_silverbox.npz") as box:
        u, y = box["u"].ravel(), box["y"].ravel()
    cut = 40650 + int(0.75 * (127400 - 40650))
    return tuple(optid.Data(u[part], y[part], dt=1 / 610.35) for part in (slice(40650, 48650), slice(cut, 127400)))


def _three_tanks(folder: Path) -> tuple[optid.Data, optid.Data]:
    with np.load(folder / "three_tank_dts200_fdi.npz") as rig:
        runs = np.split(rig["normal"], 8)
    return tuple(optid.Data([r[:, :2] for r in some], [r[:, 2:] for r in some]) for some in (runs[:4], runs[4:]))


def spent() -> float:
    """Return the CPU seconds of this process and its children so far."""
    return time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def score(model: Any, test: optid.Data) -> float:
    """Return the fit in % of the free run on a record, a mean over the outputs; minus infinity where there is none."""
    found = float(np.mean(prediction_fit(model, test, "simulation")))
    return found if np.isfinite(found) else -np.inf


def refitted(train: optid.Data, test: optid.Data, trial: Any) -> float:
    """Return the validation fit of a structure fitted to the whole estimation part."""
    try:
        return score(optid.fit(train, trial.candidate.formulation, prove=False, raises=False,
                               **trial.candidate.arguments).model, test)
    except OptidError:
        return -np.inf


def on_records(folder: Path, effort: str, only: list[str] | None, oracle: bool) -> None:
    regrets, behind = [], []
    print(f"{'record':<14}{'chosen':<58}{'cv %':>6}{'val %':>8}{'linear':>8}{'oracle':>8}  verdict   CPU s")
    for name, load in records(folder):
        if only and name not in only:
            continue
        train, test = load()
        before = spent()
        found = identify(train, effort=effort, workers=1)
        used = spent() - before
        reached = score(found.model, test)
        plain = refitted(train, test, found.best["linear"]) if "linear" in found.best else np.nan
        best = np.nan
        if oracle:
            complete = [t for t in found.trials if np.isfinite(t.score)]
            best = max([reached, *(refitted(train, test, t) for t in complete)])
            regrets.append(best - reached)
        behind.append(plain - reached)
        structure = f"{found.chosen.candidate.formulation} {found.chosen.candidate.words}"
        print(f"{name:<14}{structure[:57]:<58}{found.chosen.score:6.1f}{reached:8.2f}{plain:8.2f}{best:8.2f}  "
              f"{found.verdict.word:<8}{used:7.1f}{' (effort spent)' * bool(found.stopped)}", flush=True)
    print(f"largest loss against the linear model: {max(behind):.2f} points (goal 0.5)")
    if regrets:
        print(f"mean regret: {np.mean(regrets):.2f} points (goal 2.5)")


# -- simulated plants ------------------------------------------------------------------------------------------------


def on_plant(task: tuple[str, int, str]) -> tuple[str, bool, float, float, float, float, str, str]:
    """Search a simulated record: class, whether it is right, errors, fits in %, CPU seconds, verdict, structure."""
    kind, seed, effort = task
    warnings.simplefilter("ignore")
    one, before = record(kind, seed), spent()
    found = identify(one.train, effort=effort, workers=1)
    used, chosen = spent() - before, found.chosen.candidate
    y = one.test.y
    best = pooled_fit((one.clean - y) ** 2, (y - y.mean(axis=0)) ** 2)
    return (chosen.kind, chosen.kind in one.classes, one.error(found.model), score(found.model, one.test), best, used,
            found.verdict.word, f"{chosen.formulation} {chosen.words}{' (effort spent)' * bool(found.stopped)}")


def on_plants(kinds: list[str], effort: str, seeds: int, jobs: int) -> None:
    print(f"{'record':<26}{'error %':>8}{'fit %':>8}{'best %':>8}{'CPU s':>7}  verdict  chosen")
    rows = []
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        tasks = [(kind, seed, effort) for kind in kinds for seed in range(seeds)]
        for (kind, seed, _), row in zip(tasks, pool.map(on_plant, tasks)):
            rows.append((kind, *row))
            _, right, error, fit, best, used, word, structure = row
            print(f"{kind + ' ' + str(seed):<26}{100 * error:8.2f}{fit:8.2f}{best:8.2f}{used:7.1f}  {word:<8} "
                  f"{structure}{'' if right else ' (other class)'}", flush=True)
    print(f"\n{'kind':<26}{'right class':>12}{'within 5 %':>12}{'both':>6}{'CPU s':>7}")
    for kind in [*kinds, ""]:
        some = [row for row in rows if kind in (row[0], "")]
        right, near = np.array([row[2] for row in some]), np.array([row[3] <= NEAR for row in some])
        print(f"{kind or 'all':<26}{100 * right.mean():10.0f} %{100 * near.mean():10.0f} %"
              f"{100 * np.mean(right & near):4.0f} %{np.mean([row[6] for row in some]):7.1f}")
    praised, sound = ([row for row in rows if row[7] in words] for words in (("good", "fair"), ("poor", "useless")))
    print(f"good or fair, but off by more than 10 %: {sum(row[3] > 2 * NEAR for row in praised)} of {len(praised)}; "
          f"poor or useless, but within 5 %: {sum(row[3] <= NEAR for row in sound)} of {len(sound)}")


def sums() -> None:
    """Compare the scan by exact sums with fits to the record without every block."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=20_000)
    y = np.convolve(u, 0.9 ** np.arange(60))[:20_000] + rng.normal(size=20_000)
    blocks = Blocks.of(optid.Data(u, y))
    clock = time.process_time()
    found = scan(LagSums(blocks), [(0,)])
    exact = time.process_time() - clock
    clock = time.process_time()
    for one in found[:8]:
        for b in range(len(blocks)):
            optid.fit(blocks.without(b), "arx", na=one.na, nb=one.nb, nk=0, prove=False)
    naive = (time.process_time() - clock) * len(found) / 8
    print(f"{len(found)} orders, 4 blocks, 20,000 samples: {exact:.2f} CPU s by exact sums, {naive:.1f} by fits: "
          f"{naive / exact:.0f} times less")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default=os.environ.get("OPTID_DATA"))
    parser.add_argument("--effort", default="normal")
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--oracle", action="store_true")
    parser.add_argument("--plants", nargs="*", choices=[*ORDINARY, *LIKENESSES])
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--sums", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.sums:
        sums()
    elif options.plants is not None:
        on_plants(options.plants or list(ORDINARY), options.effort, options.seeds, options.jobs)
    elif not options.data:
        parser.error("name the folder of the records with --data or OPTID_DATA")
    else:
        known = [name for name, _ in records(Path(options.data))]
        if unknown := set(options.only or ()) - set(known):
            parser.error(f"--only knows no {', '.join(sorted(unknown))}: use {', '.join(known)}")
        on_records(Path(options.data), options.effort, options.only, options.oracle)


if __name__ == "__main__":
    main()
