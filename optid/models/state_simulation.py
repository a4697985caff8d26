"""The three simulators of a state-space model, and the initial state of each by least squares.

P1 predicts with the innovation form, P2 feeds the measured outputs to g without correcting the state, P3 runs freely.
Inputs are expanded stretch by stretch, so nothing of the size samples x functions is formed for the whole record.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array, compact
from optid.errors import DataError
from optid.models.experiments import check_inputs, scaled_least_squares, signal_units
from optid.models.recursions import SHORT, propagate
from optid.models.state_signals import Direct, Parts, Signals, Stretch
from optid.models.state_space import StateSpace

STRETCH = 16384  # samples expanded at a time
FAR = 100.0  # a simulation that leaves this many times the range of the data has diverged
# a derivative with respect to the initial state below this share of its largest value carries no information
FORGOTTEN = 1e-12
STEPS = 50
SETTLED = 1e-20  # a step with a smaller predicted share of the squared error is the last one
DIGITS = 1e-15  # of the outputs; a step with a smaller predicted reduction than their square is the last one, too
ROUNDING = 1e-14
SHORTEST, LONGER = 8, 4  # samples of the shortest beginning of a run, and ratio of the lengths of the next ones
SOME = 8  # states of a run that are tried as initial ones
ENOUGH = 1e-4  # as SETTLED, for beginnings
BAD = 4.0  # ratio of the mean squared errors of a beginning to that after it which is more than noise
NOTHING = Direct.of()  # what unknowns besides the initial state change
SIMULATORS = ("predict", "measured_feedback", "free")


class Run(NamedTuple):
    """One record under one simulator."""

    model: StateSpace  # the model
    u: Array  # (N, m) inputs
    y: Array  # (N, l) outputs; NaN where there are none
    known: Array | None  # those that the simulator may see, NaN elsewhere; None for a free run
    gain: Array  # (n, l) gain of the correction
    low: Array  # (l,) lower end of the range allowed
    high: Array  # (l,) upper end
    label: str  # words that name the experiment in a message


def prepare_run(model: StateSpace, simulator: str, u: Array, y: Array | None, limits: Any, label: str) -> Run:
    """Return what a simulator, "predict" (P1), "measured_feedback" (P2) or "free" (P3), runs over.

    Outputs y (N, l) may be None for P3 only, the limits (low, high), each (l,), from `allowed_range`, None for the
    range of numbers. A missing input is refused (`DataError`).
    """
    check_inputs(model, u, label)
    none = np.zeros_like(model.K)
    low, high = limits if limits is not None else (np.full(model.l, -np.finfo(float).max), np.finfo(float).max)
    low, high = (np.array(np.broadcast_to(end, model.l), dtype=float) for end in (low, high))
    known = None if simulator == "free" else y
    measured = np.full((len(u), model.l), np.nan) if y is None else y
    return Run(model, u, measured, known, model.K if simulator == "predict" else none, low, high, label)


def run(job: Run, x0: Array, horizon: int = 1) -> Array:
    """Compute the outputs (N, l) from the initial state (n,); refuse one that leaves the range allowed (`DataError`).

    With a horizon the model runs freely for `horizon` - 1 samples from the state before every sample; the first
    `horizon` - 1 outputs are NaN.
    """
    model, outputs, x = job.model, np.full((len(job.u), job.model.l), np.nan), np.array(x0, dtype=float)
    for first in range(0, len(job.u), STRETCH):
        last = min(first + STRETCH + horizon - 1, len(job.u))
        stretch = stretch_of(job, slice(first, last))
        states, y = march(job, first, stretch.part(slice(STRETCH)), x, keep=horizon > 1)
        for i in range(1, horizon):
            states, y = states[: last - first - i], y[: last - first - i]  # those after which i samples follow
            now, then = (slice(j, j + len(states)) for j in (i - 1, i))
            with np.errstate(all="ignore"):
                h = model.latent_values(stretch.z[now] + states @ model.Cz.T)
                states = states @ model.A.T + stretch.drive[now] + y @ model.L.T + h @ model.Ez.T
                for j, (g, o) in enumerate(zip(model.feedback, model.output_of)):
                    states += g(y[:, o])[:, None] * model.E[:, j]
                h = model.latent_values(stretch.z[then] + states @ model.Cz.T)
                y = states @ model.C.T + stretch.direct[then] + h @ model.Fz.T
            beyond = ~np.all((job.low <= y) & (y <= job.high), axis=1)
            if beyond.any():
                raise _left(job, first + i + int(np.argmax(beyond)))
        outputs[first + horizon - 1 : first + horizon - 1 + len(y)] = y
    return outputs


def run_states(job: Run, x0: Array) -> Array:
    """Compute the states (N, n) of a run; errors as `run`."""
    x, starts = np.array(x0, dtype=float), range(0, len(job.u), STRETCH)
    return np.vstack([march(job, k, stretch_of(job, slice(k, k + STRETCH)), x)[0] for k in starts])


def fitted_state(job: Run, y: Array, x0: Array | None = None) -> Array:
    """Estimate the initial state (n,) by least squares of the outputs of a simulator on the measured ones y (N, l).

    The errors of each output count in units of its standard deviation. P1 and P2 are linear in the state (where an
    output is missing, its feedback is not), a free run with feedback is not: Gauss-Newton steps from x0 (zero by
    default), halved until the error falls; where a beginning of the run is followed much worse than the rest, once more
    from the state that is fitted to beginnings. Directions that the record does not determine are left as they are. A
    run that leaves the range allowed from every start tried is refused (`DataError`).
    """
    n = job.model.nx
    x = np.zeros(n) if x0 is None else np.array(x0, dtype=float)
    if n == 0 or not np.isfinite(y).any():
        return x
    unit = signal_units(y)
    if not job.model.latent and (
            not job.model.feedback or (job.known is not None and not np.isnan(job.known).any())):
        root, _ = _linearised(job, y, unit, x, whole=False)
        return x + np.asarray(scaled_least_squares(root[:, :n], root[:, n]))
    found, cost = _descended(job, y, unit, x)
    if _begins_badly((y - run(job, found)) / unit):
        with suppress(DataError):
            other, lower = _descended(job, y, unit, _from_beginnings(job, y, unit, [x, *_some(run_states(job, found))]))
            return other if lower < cost else found
    return found


def _descended(job: Run, y: Array, unit: Array, x: Array, settled: float = SETTLED) -> tuple[Array, float]:
    """Take Gauss-Newton steps from an initial state (n,); return where they end, and the squared error there."""
    n = x.size
    root, cost = _linearised(job, y, unit, x)
    rounding = DIGITS**2 * float(np.nansum((y / unit) ** 2))
    for _ in range(STEPS):
        step = scaled_least_squares(root[:, :n], root[:, n])
        expected = float(np.sum((root[:, :n] @ step) ** 2))
        for halving in range(20):
            trial = x + step / 2**halving
            try:
                near, lower = _linearised(job, y, unit, trial)
            except DataError:
                continue
            if lower <= cost * (1 + ROUNDING):
                break
        else:
            break
        x, root, cost = trial, near, lower
        if expected <= settled * cost + rounding:
            break
    return x, cost


def _begins_badly(error: Array) -> bool:
    """Whether errors (N, l) are much larger over some beginning than after it: the state may be a poor optimum."""
    square = np.nansum(error**2, axis=1)
    return any(square[:length].mean() > BAD * square[length:].mean() for length in _beginnings(len(error)))


def _beginnings(samples: int) -> Iterator[int]:
    """Yield the lengths of beginnings of a run, each several times the one before."""
    length = SHORTEST
    while 2 * length <= samples:
        yield length
        length *= LONGER


def _some(states: Array) -> Array:
    """Return a few states (N, n) of a run."""
    return states[:: max(len(states) // SOME, 1)][1:]


def _from_beginnings(job: Run, y: Array, unit: Array, starts: Sequence[Array]) -> Array:
    """Return the state (n,) that is fitted to a few samples, then to more: these leave fewer optima than a long run.

    Of several starts the one counts that is best after the second length.
    """
    found = [(np.inf, x) for x in starts]
    for length in _beginnings(len(y)):
        part = job._replace(u=job.u[:length], y=job.y[:length], known=None if job.known is None else job.known[:length])
        ended = []
        for _, x in found:
            with suppress(DataError):
                state, cost = _descended(part, y[:length], unit, x, ENOUGH)
                ended.append((cost, state))
        found = ended if length == SHORTEST else sorted(ended, key=lambda one: one[0])[:1]
    if not found:
        raise DataError(f"{job.label}no run from any start stays within the range allowed")
    return found[0][1]


def _linearised(job: Run, y: Array, unit: Array, x0: Array, whole: bool = True) -> tuple[Array, float]:
    """Return the triangular root (n + 1, n + 1) of [derivative, error] over the samples present, and the error^2.

    Where the error of the whole record is not needed, the run ends when the initial state has no effect any more.
    """
    n, outputs = x0.size, job.model.l
    root, cost, largest, informs = np.zeros((0, n + 1)), 0.0, 0.0, True
    x, turn, length = np.array(x0, dtype=float), np.eye(n), max(64, STRETCH // (n * outputs + 1))
    for first in range(0, len(job.u), length):
        if not (informs or whole):
            break
        stretch = stretch_of(job, slice(first, first + length))
        states, simulated = march(job, first, stretch, x)
        error = (y[first : first + length] - simulated) / unit
        present = ~np.isnan(error)
        with np.errstate(over="ignore"):
            cost += float(np.sum(error[present] ** 2))
        if informs:
            jacobian, turn = _by_start(job, first, stretch, states, simulated, turn)
            rows = np.column_stack([(jacobian / unit[:, None])[present], error[present]])
            if not (np.all(np.isfinite(rows)) and np.isfinite(cost)):
                raise DataError(
                    f"{job.label}The effect of the initial state leaves the range of numbers: the largest pole has "
                    f"radius {job.model.radius:.6g}.")
            root = np.asarray(np.linalg.qr(np.vstack([root, rows]), mode="r"))
            largest = max(largest, float(np.abs(turn).max()))
            informs = float(np.abs(turn).max()) > FORGOTTEN * largest
    return root, cost


def _by_start(job: Run, first: int, stretch: Stretch, states: Array, simulated: Array, turn: Array
              ) -> tuple[Array, Array]:
    """Return the derivatives (T, l, n) of the outputs of a stretch, and that (n, n) of the state after it."""
    model, known = job.model, None if job.known is None else job.known[first : first + len(states)]
    linear = known is not None and not (model.latent or model.feedback or np.isnan(known).any())
    if linear and len(states) <= SHORT:  # nothing to be compiled
        F, drive = model.A - job.gain @ model.C, np.zeros((len(states), *turn.shape))
        drive[0] = turn
        with np.errstate(all="ignore"):
            moved = propagate(F, drive)
            return model.C @ moved, F @ moved[-1]
    from optid.models.state_kernels import sensitivities

    jacobian, turn = np.empty((*simulated.shape, len(turn))), turn.copy()
    sensitivities(model.parts, NOTHING, signals(job, stretch, states, simulated), turn, jacobian)
    return jacobian, turn


def allowed_range(data: Any, times: float = FAR) -> Any:
    """Return (low, high), each (l,): so many times the range of every output about its middle, over all experiments.

    None where the outputs are not known; no bound for an output without two different values.
    """
    outputs = [y for y in data if y is not None]
    if not outputs:
        return None
    low = np.fmin.reduce([np.fmin.reduce(y, axis=0) for y in outputs])
    high = np.fmax.reduce([np.fmax.reduce(y, axis=0) for y in outputs])
    width = np.where(high > low, high - low, np.maximum(np.abs(low), np.abs(high)))
    reach = np.where(width > 0, times * width, np.finfo(float).max)
    middle = np.where(np.isfinite(low), (low + high) / 2, 0.0)
    reach = np.where(np.isfinite(low), reach, np.finfo(float).max)
    return middle - reach, middle + reach


def stretch_of(job: Run, samples: slice, f: Array | None = None) -> Stretch:
    """Return what drives some samples of a run; ``f`` (T, r) are the values of the nonlinearities where known."""
    model, u = job.model, job.u[samples]
    f = model.expand_inputs(u) if f is None else f
    y = np.full((len(u), model.l), np.nan) if job.known is None else job.known[samples]
    g = np.empty((len(u), len(model.feedback)))
    for j, (function, o) in enumerate(zip(model.feedback, model.output_of)):
        g[:, j] = np.nan if job.known is None else function(y[:, o])
    driven = (f @ model.B.T + model.offset_x, f @ model.D.T + model.offset_y, g, y, u @ model.Dz.T + model.offset_z)
    return Stretch._make([*map(compact, driven), job.low, job.high])


def signals(job: Run, stretch: Stretch, states: Array, outputs: Array) -> Signals:
    """Describe a run over a stretch with its states (T, n) and outputs (T, l), but for the `values` of unknowns."""
    from optid.models.state_kernels import slopes as write_slopes

    model, missing, tables = job.model, np.isnan(stretch.y), job.model.parts.tables
    z = stretch.z + states @ model.Cz.T
    slopes = np.zeros_like(z)
    if tables.compiled:
        write_slopes(tables, len(model.feedback), z, slopes)
    else:
        for j, h in enumerate(model.latent):
            slopes[:, j] = h.slope(z[:, j])
    returned = np.zeros((0, model.nx, model.l))
    if np.any(job.gain) or (missing.any() and (model.feedback or np.any(model.L))):
        own = model.output_feedback(outputs) if missing.any() else 0.0
        returned = np.where(missing[:, None, :], own, -job.gain)
    return Signals(compact(returned), slopes, np.zeros((len(states), 0)))


def march(job: Run, first: int, stretch: Stretch, x: Array, keep: bool = True) -> tuple[Array, Array]:
    """Run from a state x, which moves on, over a stretch that begins at sample `first`; return its states and outputs.

    The states before every sample are (T, n), (0, n) where they are not kept. An output that leaves the range allowed,
    or the interval of a basis that refuses, raises a `DataError`.
    """
    from optid.models.state_kernels import LEFT, REFUSED
    from optid.models.state_kernels import march as run_over

    parts, count = job.model.parts._replace(K=compact(job.gain)), len(stretch.y)
    states, outputs = np.empty((count if keep else 0, x.size)), np.empty((count, job.model.l))
    if not parts.tables.compiled and (job.model.latent or np.isnan(stretch.feedback).any()):
        ended, at = _march_by_steps(job.model, parts, stretch, x, outputs, states)
    else:
        ended, at = run_over(parts, stretch, x, outputs, states)
    if ended == REFUSED:
        what = "argument of a latent function" if job.model.latent else "simulated output"
        raise DataError(
            f"{job.label}At sample {first + at} the {what} leaves the interval of a basis with outside='error'. Use "
            "outside='clamp' or 'extrapolate', or a longer interval.")
    if ended == LEFT:
        raise _left(job, first + at)
    return states, outputs


def _left(job: Run, sample: int) -> DataError:
    """The error that says at which sample a run left the range allowed."""
    finite = bool(np.all(job.high < np.finfo(float).max))
    what = f"{FAR:g} times the range of the data" if finite else "the range of numbers"
    return DataError(
        f"{job.label}The simulated output leaves {what} at sample {sample}: the largest pole has radius "
        f"{job.model.radius:.6g}. Identify the model with a stability constraint, predict one step ahead, or simulate "
        "fewer samples.")


def _march_by_steps(model: StateSpace, parts: Parts, stretch: Stretch, x: Array, outputs: Array, states: Array
                    ) -> tuple[int, int]:
    """Run the kernel sample by sample, with the values of functions that it cannot evaluate."""
    from optid.models.state_kernels import INSIDE
    from optid.models.state_kernels import march as run_over

    plain = parts._replace(Ez=np.zeros((x.size, 0)), Fz=np.zeros((model.l, 0)), Cz=np.zeros((0, x.size)))
    for k in range(len(stretch.y)):
        here = slice(k, k + 1)
        h = model.latent_values(stretch.z[here] + model.Cz @ x)[0]
        direct = stretch.direct[k] + parts.Fz @ h
        y, g = direct + parts.C @ x, stretch.feedback[k].copy()
        for j in np.flatnonzero(np.isnan(g)) if np.all((stretch.low <= y) & (y <= stretch.high)) else ():
            g[j] = model.feedback[j](y[model.output_of[j]])
        one = stretch.part(here)._replace(feedback=g[None], direct=direct[None],
                                          drive=(stretch.drive[k] + parts.Ez @ h)[None])
        ended, _ = run_over(plain, one, x, outputs[here], states[here])
        if ended != INSIDE:
            return ended, k
    return INSIDE, len(stretch.y)
