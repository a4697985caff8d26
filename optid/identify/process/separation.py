"""What a record does not determine about a process: refused by name, with what it determines all the same."""

import warnings
from dataclasses import replace

import numpy as np

from optid.arrays import Array
from optid.errors import DataWarning, RankError
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend, search_cells
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.starts import usual_box
from optid.phrases import p_equals

CHANCE = 1e-3  # p value of the F test above which the output does not visibly respond
MOVING, EXACT = 1e-4, 1e-12  # p value, and share of the energy of the output, below which a motion counts as none
NEAR = 0.02  # of a logarithm from its bound that counts as none
MANYFOLD = 3.0  # standard error of a logarithm from which on a time constant is not determined
SHARE = 0.1  # of a direction from which on a parameter takes part in it
ALIKE = 1e-7  # singular value of the scaled derivatives, relative to the largest, at which parameters are not separable


def refuse_silence(errors: ProcessErrors, best: ProcessPoint) -> None:
    """Refuse a record in which the output shows no response to any input (`RankError`)."""
    from scipy.stats import f as fisher

    u = errors.unknowns
    still = best.columns[:, sum(u.sizes) :]
    rest = errors.y - still @ np.linalg.lstsq(still, errors.y, rcond=None)[0] if still.shape[1] else errors.y
    used, dof = len(u.dynamic) + sum(u.sizes), len(errors.y) - u.size
    before = float(rest @ rest)
    ratio = (before - best.value) / used / max(best.value / dof, 1e-300)
    if fisher.sf(ratio, used, dof) < CHANCE:
        return
    level = errors.units.y_offset[0] + errors.units.y_scale[0] * float(np.mean(errors.y))
    size = errors.units.y_scale[0] * np.sqrt(before / len(errors.y))
    raise RankError(
        f"output {errors.data.outputs[0]!r} shows no response to {', '.join(errors.data.inputs)} (p = "
        f"{fisher.sf(ratio, used, dof):.2g}): the dead time may be longer than the record, or the gain small beside "
        f"the noise. Determined is its level alone, {level:.4g} (standard deviation {size:.2g}). Use a longer record "
        "or a larger step")


def refuse_inseparable(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint) -> None:
    """Refuse time constants and dead times that the record shows only together (`RankError`)."""
    u, at = errors.unknowns, errors.unknowns.dynamic
    _refuse_instant(errors, box, best)
    basis = np.linalg.qr(best.columns)[0]
    slopes = _with_equal_ones_together(errors, best)
    left = slopes - basis @ (basis.T @ slopes)
    names = [errors.key(name, c) for c, one in enumerate(u.structures) for name in one.names]
    sizes, box = np.linalg.norm(left, axis=0), usual_box(errors)
    inner = (best.x[at] > box.low + 1e-9) & (best.x[at] < box.high - 1e-9)
    whole = np.linalg.norm(slopes, axis=0)
    silent = [name for name, size, much, free in zip(names, sizes, whole, inner)
              if free and much > 0 and size <= ALIKE * much]
    if silent:
        raise RankError(f"{', '.join(silent)} {'have' if silent[1:] else 'has'} no effect on this record that the gain "
                        f"does not have as well. {_determined(errors, best)}")
    used = left[:, inner & (sizes > 0)] / sizes[inner & (sizes > 0)]
    if used.shape[1] < 2:
        return
    values, vectors = np.linalg.svd(used, full_matrices=False)[1:]
    if values[-1] > ALIKE * values[0]:
        return
    kept = [name for name, there in zip(names, inner & (sizes > 0)) if there]
    parts = [name for name, part in zip(kept, np.abs(vectors[-1])) if part > SHARE]
    raise RankError(f"{', '.join(parts)} can change together without any effect on this record: it does not separate "
                    f"them. {_determined(errors, best)}")


def warn_of_motion(errors: ProcessErrors, best: ProcessPoint) -> str:
    """Warn where experiments do not begin at rest: a score test of motions of their own; return its finding or ""."""
    from scipy.stats import f as fisher

    u = errors.unknowns
    if u.free:
        return ""
    free = replace(errors, unknowns=replace(u, free=True))
    x = np.concatenate([best.x[: u.shared], np.zeros(free.unknowns.size - u.shared)])
    every = free.columns(x)
    known = np.column_stack([best.columns, errors.slopes(best.x)])
    motions = every[:, len(u.linear) - u.n * u.experiments :]
    basis = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300))[0]
    left = motions - basis @ (basis.T @ motions)
    sizes = np.linalg.norm(left, axis=0)
    left = left[:, sizes > 1e-6 * np.linalg.norm(motions, axis=0)] if left.size else left
    dof = len(errors.y) - known.shape[1] - left.shape[1]
    if not left.shape[1] or dof < 1:
        return ""
    gain = float(np.sum((np.linalg.qr(left)[0].T @ best.errors) ** 2))
    p = float(fisher.sf(gain / left.shape[1] / max((best.value - gain) / dof, 1e-300), left.shape[1], dof))
    if p >= MOVING or gain <= EXACT * errors.energy:
        return ""
    found, of = f"not at rest ({p_equals(p, 1)})", errors.data.outputs[0]
    warnings.warn(f"output {of!r} does not begin at rest under its first inputs ({p_equals(p, 1)}): initial='free' "
                  "estimates a motion of its own for every experiment; gain and time constants are biased without it",
                  DataWarning, stacklevel=2)
    return found


def describe_bounds(errors: ProcessErrors, best: ProcessPoint) -> str:
    """Return which parameters lie at the smallest or largest value that is tried, and what that means; "" for none."""
    box, found, j = usual_box(errors), [], 0
    for c, one in enumerate(errors.processes(best.x)):
        for name, value in zip(one.structure.names, one.in_unit(1 / errors.data.dt).p):
            number = best.x[errors.unknowns.dynamic][j]
            low, high = number <= box.low[j] + NEAR, number >= box.high[j] - NEAR
            if name != "dead_time" and (low or high):
                means = "fewer poles may do" if low else "the process may integrate (I in its type)"
                size = f"{value:.4g} {errors.data.time_unit * (name != 'zeta')}".rstrip()
                found.append(f"{errors.key(name, c)} at the {'smallest' if low else 'largest'} value that is tried, "
                             f"{size}: {means if name not in ('zeta', 'tau_zero') else 'it is not determined'}")
            j += 1
    return "; ".join(found)


def describe_flatness(errors: ProcessErrors, best: ProcessPoint) -> str:
    """Return which parameters may change manyfold, together, without an effect beyond the noise; "" for none.

    Those at a bound are not among them: see `describe_bounds`.
    """
    box, at = usual_box(errors), errors.unknowns.dynamic
    basis = np.linalg.qr(best.columns)[0]
    slopes = _with_equal_ones_together(errors, best)
    slopes = slopes - basis @ (basis.T @ slopes)
    names = [errors.key(name, c) for c, one in enumerate(errors.unknowns.structures) for name in one.names]
    logs = np.concatenate([one.logarithmic for one in errors.unknowns.structures])
    sizes, gap = np.linalg.norm(slopes, axis=0), np.where(logs, NEAR, 1e-9)
    free = np.flatnonzero((best.x[at] > box.low + gap) & (best.x[at] < box.high - gap) & (sizes > 0))
    if len(free) < 1:
        return ""
    noise = np.sqrt(best.value / max(len(errors.y) - errors.unknowns.size, 1))
    values, vectors = np.linalg.svd(slopes[:, free] / sizes[free], full_matrices=False)[1:]
    # by how much the noise lets every number change in the direction that the record shows least
    moves = np.abs(vectors[-1]) * noise / sizes[free] / max(values[-1], 1e-300)
    loose = moves > np.where(logs[free], MANYFOLD, errors.length)
    if not loose.any():
        return ""
    found = [names[free[i]] for i in np.flatnonzero(np.abs(vectors[-1]) > SHARE)]
    return (f"{', '.join(found)}: {'together they' if found[1:] else 'it'} may change manyfold without visible effect; "
            "a simpler type may do")


def _with_equal_ones_together(errors: ProcessErrors, best: ProcessPoint) -> Array:
    """Return the derivatives by all numbers; of equal time constants the first has those of all, the others none."""
    slopes, place = errors.slopes(best.x), 0
    for c, one in enumerate(errors.unknowns.structures):
        logs = best.x[errors.unknowns.slices[f"dynamics{c}"]][: one.real]
        for i in range(1, one.real):
            for j in range(i):
                if logs[i] == logs[j] and slopes[:, place + i].any():
                    slopes[:, place + j] += slopes[:, place + i]
                    slopes[:, place + i] = 0.0
        place += len(one.names)
    return slopes


def describe_equal_ones(errors: ProcessErrors, best: ProcessPoint) -> str:
    """Return which time constants coincide, and what that means; "" for none."""
    found = []
    for c, one in enumerate(errors.unknowns.structures):
        logs = best.x[errors.unknowns.slices[f"dynamics{c}"]][: one.real]
        if len(set(logs.tolist())) < len(logs):
            found.append(f"equal{'' if errors.data.m == 1 else f' ({errors.data.inputs[c]})'}: the record asks for a "
                         "complex pair (U in the type), or for fewer poles")
    return "; ".join(found)


def _refuse_instant(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint) -> None:
    """Refuse a time constant below a sampling time that is not told from zero beside a dead time (`RankError`)."""
    from scipy.stats import f as fisher

    dof = len(errors.y) - errors.unknowns.size
    for c, one in enumerate(errors.unknowns.structures):
        first = errors.unknowns.slices[f"dynamics{c}"].start
        place = errors.place(c) - len(one.names) + 1
        if one.names != ("tau", "dead_time") or best.x[first] > 0 or box.low[place] == box.high[place]:
            continue
        x = best.x.copy()
        x[first + 1] += np.exp(best.x[first])
        x[first] = box.low[place]
        held = box.within(place, box.low[place], box.low[place])
        found = search_cells(errors, descend(errors, x, held)[0], held)
        if found.value <= best.value * (1 + fisher.ppf(0.95, 1, dof) / dof):
            name = errors.key("tau", c)
            raise RankError(f"{name} lies below a sampling time and is not told from zero: it does not separate from "
                            f"{errors.key('dead_time', c)}. {_determined(errors, best)}")


def _determined(errors: ProcessErrors, best: ProcessPoint) -> str:
    """Say which sum of times the record determines all the same, and what to do."""
    found = []
    for c, one in enumerate(errors.processes(best.x)):
        lag = one.in_unit(1 / errors.data.dt)
        total = lag.p[: one.structure.real].sum() + 2 * lag.value("zeta") * lag.value("T") + lag.dead_time
        of = f" ({errors.data.inputs[c]})" if errors.data.m > 1 else ""
        found.append(f"{total - lag.value('tau_zero'):.4g}{of}")
    sums = f"{', '.join(found)} {errors.data.time_unit}".rstrip()
    return (f"Determined is their sum, the mean delay of the response: {sums}. Sample faster, choose fewer poles, or "
            "hold one by a constraint such as dead_time:0")
