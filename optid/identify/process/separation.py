"""What a record does not determine about a process: refused by name, with what it determines all the same."""

import warnings
from dataclasses import replace

import numpy as np

from optid.arrays import Array
from optid.errors import DataWarning, RankError
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend, search_cells
from optid.identify.process.starts import usual_box
from optid.phrases import p_equals

CHANCE = 1e-3  # p value of the F test above which the output does not visibly respond
MOVING, EXACT = 1e-4, 1e-12  # p value, and share of the energy of the output, below which a motion counts as none
USUAL = 10.0  # time constants that a record of a step is long
NEAR = 0.02  # of a logarithm from its bound that counts as none
MANYFOLD = 3.0  # standard error of a logarithm from which on a time constant is not determined
SHARE = 0.1  # of a direction from which on a parameter takes part in it
TAUS = ("tau1", "tau2", "tau3")  # of which several may be equal
ALIKE = 1e-7  # singular value of the scaled derivatives, relative to the largest, at which parameters are not separable


def examine(best: ProcessPoint, box: ProcessBox) -> dict[str, str]:
    """Refuse a point whose numbers the record does not determine (`RankError`), warn, and say what is doubtful."""
    _refuse_silence(best)
    motion = _warn_of_motion(best)  # first: it may be why times do not separate
    _refuse_inseparable(best, box)
    told = {"start": motion, "bounds": _describe_bounds(best), "not determined": _describe_flatness(best),
            "time constants": _describe_equal_ones(best)}
    return {name: said for name, said in told.items() if said}


def _refuse_silence(best: ProcessPoint) -> None:
    """Refuse a record in which the output shows no response to any input (`RankError`)."""
    errors, u = best.errors, best.errors.unknowns
    still, used = best.columns[:, sum(u.sizes) :], len(u.dynamic) + sum(u.sizes)
    rest = errors.y - still @ np.linalg.lstsq(still, errors.y, rcond=None)[0] if still.shape[1] else errors.y
    before = float(rest @ rest)
    p = _chance(before - best.value, used, best.value, len(errors.y) - u.size)
    if p < CHANCE:
        return
    level = errors.units.y_offset[0] + errors.units.y_scale[0] * float(np.mean(errors.y))
    size = errors.units.y_scale[0] * np.sqrt(before / len(errors.y))
    raise RankError(
        f"output {errors.data.outputs[0]!r} shows no response to {', '.join(_inputs(best))} (p = {p:.2g}): the dead "
        f"time may be longer than the record, or the gain small beside the noise. Determined is its level alone, "
        f"{level:.4g} (standard deviation {size:.2g}). Use a longer record or a larger step")


def _chance(gain: float, columns: int, rest: float, dof: int) -> float:
    """Return the p value of the F test of so many columns that lower the sum of squares by a gain, to a rest."""
    from scipy.stats import f as fisher

    return float(fisher.sf(gain / columns / max(rest / dof, 1e-300), columns, dof))


def _inputs(best: ProcessPoint) -> list[str]:
    return [best.errors.data.inputs[c] for _, c in best.errors.unknowns.pairs]


def _refuse_inseparable(best: ProcessPoint, box: ProcessBox) -> None:
    """Refuse time constants and dead times that the record shows only together (`RankError`)."""
    _refuse_instant(best, box)
    slopes, names = _with_equal_ones_together(best), np.array(_names(best))
    left, usual = best.without_linear(slopes), usual_box(best.errors)
    inner = (best.numbers > usual.low + 1e-9) & (best.numbers < usual.high - 1e-9)
    sizes, whole = np.linalg.norm(left, axis=0), np.linalg.norm(slopes, axis=0)
    silent = names[inner & (whole > 0) & (sizes <= ALIKE * whole)]
    if silent.size:
        raise RankError(f"{', '.join(silent)} {'have' if silent.size > 1 else 'has'} no effect on this record that the "
                        f"gain does not have as well. {_determined(best)}")
    kept = inner & (sizes > 0)
    if kept.sum() < 2:
        return
    values, vectors = np.linalg.svd(left[:, kept] / sizes[kept], full_matrices=False)[1:]
    if values[-1] <= ALIKE * values[0]:
        parts = names[kept][np.abs(vectors[-1]) > SHARE]
        raise RankError(f"{', '.join(parts)} can change together without any effect on this record: it does not "
                        f"separate them. {_determined(best)}")


def _warn_of_motion(best: ProcessPoint) -> str:
    """Warn where experiments do not begin at rest: a score test of motions of their own; return its finding or ""."""
    errors, u = best.errors, best.errors.unknowns
    if u.free:
        return ""
    free = replace(errors, unknowns=replace(u, free=True))
    x = np.concatenate([best.x[: u.shared], np.zeros(free.unknowns.size - u.shared)])
    unseen = [place for place, (_, name) in zip(u.dynamic, u.numbers) if name in ("tau", *TAUS, "T") and x[place] < 0]
    x[unseen] = np.log(errors.length / USUAL)  # below a sampling time they may be what a motion has made of them
    motions = free.columns(x)[:, len(u.linear) - u.n * u.experiments :]
    known = np.column_stack([best.columns, errors.slopes(best.x)])
    basis = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300))[0]
    left = motions - basis @ (basis.T @ motions)
    sizes = np.linalg.norm(left, axis=0)
    left = left[:, sizes > 1e-6 * np.linalg.norm(motions, axis=0)] if left.size else left
    dof = len(errors.y) - known.shape[1] - left.shape[1]
    if not left.shape[1] or dof < 1:
        return ""
    gain = float(np.sum((np.linalg.qr(left)[0].T @ best.rest) ** 2))
    p = _chance(gain, left.shape[1], best.value - gain, dof)
    if p >= MOVING or gain <= EXACT * errors.energy:
        return ""
    warnings.warn(f"output {errors.data.outputs[0]!r} does not begin at rest under its first inputs "
                  f"({p_equals(p, 1)}): initial='free' estimates a motion of its own for every experiment; gain and "
                  "time constants are biased without it", DataWarning, stacklevel=3)
    return f"not at rest ({p_equals(p, 1)})"


def _describe_bounds(best: ProcessPoint) -> str:
    """Return which parameters lie at the smallest or largest value that is tried, and what that means; "" for none."""
    box, data, found = usual_box(best.errors), best.errors.data, []
    values = np.concatenate([one.in_unit(1 / data.dt).p for one in best.errors.processes(best.x)])
    for j, (p, name) in enumerate(best.errors.unknowns.numbers):
        low, high = best.numbers[j] <= box.low[j] + NEAR, best.numbers[j] >= box.high[j] - NEAR
        if name != "dead_time" and (low or high):
            means = "fewer poles may do" if low else "the process may integrate (I in its type)"
            size = f"{values[j]:.4g} {data.time_unit * (name != 'zeta')}".rstrip()
            found.append(f"{best.errors.key(name, p)} at the {'smallest' if low else 'largest'} value that is tried, "
                         f"{size}: {means if name not in ('zeta', 'tau_zero') else 'it is not determined'}")
    return "; ".join(found)


def _describe_flatness(best: ProcessPoint) -> str:
    """Return which parameters may change manyfold, together, without an effect beyond the noise; "" for none.

    Those at a bound are not among them: see `_describe_bounds`.
    """
    box, logs = usual_box(best.errors), best.errors.unknowns.logarithmic
    slopes = best.without_linear(_with_equal_ones_together(best))
    sizes, gap = np.linalg.norm(slopes, axis=0), np.where(logs, NEAR, 1e-9)
    free = np.flatnonzero((best.numbers > box.low + gap) & (best.numbers < box.high - gap) & (sizes > 0))
    if len(free) < 1:
        return ""
    values, vectors = np.linalg.svd(slopes[:, free] / sizes[free], full_matrices=False)[1:]
    # by how much the noise lets every number change in the direction that the record shows least
    moves = np.abs(vectors[-1]) * best.noise / sizes[free] / max(values[-1], 1e-300)
    if not np.any(moves > np.where(logs[free], MANYFOLD, best.errors.length)):
        return ""
    found = np.array(_names(best))[free[np.abs(vectors[-1]) > SHARE]]
    return (f"{', '.join(found)}: {'together they' if found.size > 1 else 'it'} may change manyfold without visible "
            "effect; a simpler type may do")


def _names(best: ProcessPoint) -> list[str]:
    return [best.errors.key(name, p) for p, name in best.errors.unknowns.numbers]


def _with_equal_ones_together(best: ProcessPoint) -> Array:
    """Return the derivatives by all numbers; of equal time constants the first has those of all, the others none."""
    slopes, numbers = best.errors.slopes(best.x), best.errors.unknowns.numbers
    for i, (p, name) in enumerate(numbers):
        for j in range(i):
            same = numbers[j][0] == p and {name, numbers[j][1]} <= set(TAUS) and best.numbers[i] == best.numbers[j]
            if same and slopes[:, i].any():
                slopes[:, j] += slopes[:, i]
                slopes[:, i] = 0.0
    return slopes


def _describe_equal_ones(best: ProcessPoint) -> str:
    """Return which time constants coincide, and what that means; "" for none."""
    found, u = [], best.errors.unknowns
    for p, (one, name) in enumerate(zip(u.structures, _inputs(best))):
        logs = best.x[u.slices[f"dynamics{p}"]][: one.real]
        if len(set(logs.tolist())) < len(logs):
            found.append(f"equal{f' ({name})' * (len(u.pairs) > 1)}: the record asks for a complex pair (U in the "
                         "type), or for fewer poles")
    return "; ".join(found)


def _refuse_instant(best: ProcessPoint, box: ProcessBox) -> None:
    """Refuse a time constant below a sampling time that is not told from zero beside a dead time (`RankError`)."""
    from scipy.stats import f as fisher

    dof = len(best.rest) - len(best.x)
    for p, late in best.errors.unknowns.delays.items():
        place = late - 1
        if best.errors.unknowns.structures[p].names != ("tau", "dead_time") or best.numbers[place] > 0 or (
                box.low[place] == box.high[place]):
            continue
        moved = best.numbers.copy()
        moved[late] += np.exp(moved[place])
        held = box.within(place, box.low[place], box.low[place])
        found = search_cells(descend(best.errors, best.at(moved).x, held)[0], held)
        if found.value <= best.value * (1 + fisher.ppf(0.95, 1, dof) / dof):
            name, other = (best.errors.key(word, p) for word in ("tau", "dead_time"))
            raise RankError(f"{name} lies below a sampling time and is not told from zero: it does not separate from "
                            f"{other}. {_determined(best)}")


def _determined(best: ProcessPoint) -> str:
    """Say which sum of times the record determines all the same, and what to do."""
    found, data = [], best.errors.data
    for name, one in zip(_inputs(best), best.errors.processes(best.x)):
        lag = one.in_unit(1 / data.dt)
        total = lag.p[: one.structure.real].sum() + 2 * lag.value("zeta") * lag.value("T") + lag.dead_time
        found.append(f"{total - lag.value('tau_zero'):.4g}{f' ({name})' * (data.m > 1)}")
    sums = f"{', '.join(found)} {data.time_unit}".rstrip()
    return (f"Determined is their sum, the mean delay of the response: {sums}. Sample faster, choose fewer poles, or "
            "hold one by a constraint such as dead_time:0")
