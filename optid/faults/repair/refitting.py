"""The record after a fault as a regression on the open parameters: innovations and their sensitivities.

The predictor is the steady Kalman predictor of the healthy plant, started in the state at the onset. Its innovations
are linear in the values of a damaged nonlinearity, since the columns of B and D that carry it stay, and linearised in
the other parameters.
"""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.bases import Linear
from optid.data.record import Data
from optid.data.stretches import interpolate_missing
from optid.errors import DataError, DataWarning, StructureError
from optid.faults.repair.curves import Curve, curve_of
from optid.faults.repair.damage import Damage
from optid.faults.signatures import Candidate
from optid.faults.whitening import Predictor, predictor, whiten
from optid.models import HammersteinSS
from optid.models.experiments import in_units_of
from optid.models.nonlinearity import Nonlinearity

NODES = 7
"""Values of a damaged nonlinearity that are estimated, where it has no nodes of its own."""

LONGEST = 20_000
"""Samples after the fault that are used at most."""

MATRICES = ("A", "B", "C", "D")


@dataclass(frozen=True, eq=False)
class RefitPrior:
    """Prior of a refit: the plant is as it was, except for what broke.

    Attributes:
        damaged: standard deviation of a value of a damaged nonlinearity about its healthy one, in halves of the range
            of the healthy nonlinearity.
        curvature: standard deviation of its second differences about those of the healthy one times the remaining
            gain, in the same units.
        healthy: standard deviation of the entries of A, B, C and D, and of the coefficients of the other
            nonlinearities, in units of the largest entry of each; used only where all parameters are open.

    Raises:
        StructureError: a standard deviation that is not positive.
    """

    damaged: float = 0.5
    curvature: float = 0.2
    healthy: float = 0.02

    def __post_init__(self) -> None:
        for word in ("damaged", "curvature", "healthy"):
            if not getattr(self, word) > 0:
                raise StructureError(f"prior: {word} = {getattr(self, word)!r} must be a positive number.")


class RefitWindow(NamedTuple):
    """A record from the sample before the fault on, or from the fault on where no earlier sample is usable."""

    u: Array  # (N, m) inputs
    y: Array  # (N, l) readings
    present: Array  # (N, l) whether a reading is there
    fed: Array  # (N, n) E g(y) + L y of the measured outputs, missing readings interpolated
    x0: Array  # (n,) predicted state at the first sample; unknown where not held
    e0: Array  # (l,) innovation there
    held: bool  # whether the first sample is before the fault: its innovation belongs to the healthy plant

    @property
    def since(self) -> np.ndarray:
        """(N,) samples since the onset."""
        return np.arange(len(self.u)) - int(self.held)


@dataclass(frozen=True, eq=False)
class Refitting:
    """A record after a fault and the open parameters of the model."""

    model: HammersteinSS  # the healthy model
    steady: Predictor  # its predictor; its gain is kept
    windows: tuple[RefitWindow, ...]  # one per experiment
    curves: tuple[Curve, ...]  # the damaged nonlinearities
    offsets: tuple[Candidate, ...]  # faults that add a constant or a drift, whose size is estimated as well
    whole: bool  # whether the matrices and the other nonlinearities are open, too
    prior: RefitPrior

    @cached_property
    def unknowns(self) -> dict[str, Array]:
        """The unknowns by name, in order, with their values in the healthy plant."""
        found: dict[str, Array] = {}
        for curve in self.curves:
            coefficients: Any = np.linalg.solve(curve.to_nodes, curve.healthy)
            found[f"mu[{curve.name}]"], found[f"constant[{curve.name}]"] = coefficients[:-1], coefficients[-1:]
        found |= {f"size[{c.label}]": np.zeros(c.into_state.shape[1]) for c in self.offsets}
        if self.whole:
            found |= {name: getattr(self.model, name) for name in MATRICES}
            found |= {f"mu {i + 1}": self.model.nonlinearities[i].mu for i in self.others}
        if not all(window.held for window in self.windows):
            found["x0"] = np.array([window.x0 for window in self.windows])
        return found

    @cached_property
    def others(self) -> tuple[int, ...]:
        """Healthy nonlinearities with more than one coefficient."""
        damaged = {curve.column for curve in self.curves}
        return tuple(i for i, f in enumerate(self.model.nonlinearities)
                     if i not in damaged and f.basis.size > 1 and not isinstance(f.basis, Linear))

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each unknown lies in the vector, flattened row by row."""
        edges = np.cumsum([0, *(value.size for value in self.unknowns.values())]).tolist()
        return {name: slice(a, b) for name, a, b in zip(self.unknowns, edges, edges[1:])}

    def part(self, curve: Curve) -> slice:
        """Return where [mu; constant] of a damaged nonlinearity lie."""
        return slice(self.slices[f"mu[{curve.name}]"].start, self.slices[f"constant[{curve.name}]"].stop)

    @cached_property
    def start(self) -> Array:
        """The healthy plant as a vector of unknowns."""
        return self.pack(self.unknowns)

    @property
    def readings(self) -> int:
        """Readings after the fault."""
        return int(sum(w.present[int(w.held) :].sum() for w in self.windows))

    @property
    def samples(self) -> int:
        """Samples after the fault."""
        return int(sum(len(w.u) - int(w.held) for w in self.windows))

    @property
    def least(self) -> int:
        """Samples with every output that as many readings take as there are values to estimate."""
        return -(-self._open // self.model.l)

    @property
    def shortage(self) -> str:
        """Why the record is too short for a refit; "" where it is not."""
        return "" if self.readings >= self._open else (
            f"{self.readings} readings after the fault, and {self._open} values to estimate: at least {self.least} "
            "samples with every output are needed.")

    @property
    def _open(self) -> int:
        return sum(curve.values_open for curve in self.curves) + sum(c.into_state.shape[1] for c in self.offsets)

    def unpack(self, theta: Array) -> dict[str, Array]:
        """Return the unknowns by name."""
        return {name: theta[self.slices[name]].reshape(value.shape) for name, value in self.unknowns.items()}

    def pack(self, values: Any) -> Array:
        """Return the vector of unknowns given by name."""
        return np.concatenate([np.zeros(0), *(np.ravel(values[name]) for name in self.unknowns)])

    @cached_property
    def held(self) -> Array:
        """(q,) unknowns fixed at zero: the shape of a dead actuator, and a matrix of zeros."""
        held = np.zeros(self.start.size, dtype=bool)
        for curve in self.curves:
            held[self.slices[f"mu[{curve.name}]"]] = curve.dead
        for name in self.anchored:
            held[self.slices[name]] = not self.unknowns[name].any()
        return held

    @property
    def anchored(self) -> tuple[str, ...]:
        """Names of the unknowns with a healthy prior."""
        return (*MATRICES, *(f"mu {i + 1}" for i in self.others)) if self.whole else ()

    def prior_rows(self) -> tuple[Array, Array]:
        """Return the prior as rows of a least-squares problem in [z; shares lost], and their target."""
        width = self.start.size + len(self.curves)
        rows, wanted = [np.zeros((0, width))], [np.zeros(0)]
        for name in self.anchored:
            part, values = self.slices[name], np.ravel(self.unknowns[name])
            if values.any():
                spread = self.prior.healthy * np.abs(values).max()
                rows.append(np.eye(width)[part] / spread)
                wanted.append(values / spread)
        for i, curve in enumerate(self.curves):
            count, half, part = curve.nodes.size, curve.half_range, self.part(curve)
            near, bend = np.zeros((count, width)), np.zeros((max(count - 2, 0), width))
            near[:, part] = curve.to_nodes / (self.prior.damaged * half)
            second: Any = np.diff(np.eye(count), n=2, axis=0) / (self.prior.curvature * half)
            bend[:, part], bend[:, self.start.size + i] = second @ curve.to_nodes, second @ curve.healthy
            rows += [near, bend]
            wanted += [curve.healthy / (self.prior.damaged * half), second @ curve.healthy]
        return np.vstack(rows), np.concatenate(wanted)

    def evidence(self) -> float:
        """Return the log marginal likelihood of the record up to a constant; constraints are not part of it.

        Every share lost is 0.5 +- 0.5. Exact where the unknowns enter linearly.
        """
        r, s = self.linearise(self.start)
        rows, wanted = self.prior_rows()
        shares = np.eye(rows.shape[1])[self.start.size :] / 0.5
        rows, wanted = np.vstack([rows, shares]), np.concatenate([wanted, np.ones(len(shares))])
        full, target = np.pad(s, ((0, 0), (0, len(self.curves)))), s @ self.start - r
        before, after = rows.T @ rows, rows.T @ rows + full.T @ full
        known = rows.any(axis=0)  # the others, as an unknown initial state, have a flat prior
        before, mean = before[np.ix_(known, known)], np.zeros(len(before))
        mean[known] = np.linalg.solve(before, (rows.T @ wanted)[known])
        point = np.linalg.solve(after, rows.T @ wanted + full.T @ target)
        left = float(np.sum((full @ point - target) ** 2) + np.sum((rows @ point - wanted) ** 2))
        left -= float(np.sum((rows @ mean - wanted) ** 2))
        return -0.5 * (left + float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]))

    def held_out(self, samples: int) -> "Refitting":
        """Return the same without the last samples of the last window."""
        last = self.windows[-1]
        u, y, present, fed = (part[: len(last.u) - samples] for part in last[:4])
        shorter = last._replace(u=u, y=y, present=present, fed=fed)
        return replace(self, windows=(*self.windows[:-1], shorter))

    def covariance(self, sensitivities: Array) -> Array:
        """Return the covariance (q, q) of the unknowns given the record and the prior; zero along undetermined ones.

        Bounds are not part of it.
        """
        rows, _ = self.prior_rows()
        rows = np.vstack([rows, np.pad(sensitivities, ((0, 0), (0, len(self.curves))))])
        free = np.flatnonzero(np.append(np.logical_not(self.held), np.ones(len(self.curves), dtype=bool)))
        found = np.zeros((rows.shape[1],) * 2)
        found[np.ix_(free, free)] = np.linalg.pinv(rows[:, free].T @ rows[:, free], hermitian=True)
        return found[: self.start.size, : self.start.size]

    def model_at(self, theta: Array) -> HammersteinSS:
        """Return the model of a vector of unknowns; constants of damaged nonlinearities become its offsets."""
        values = self.unpack(theta)
        changes: dict[str, Any] = {name: values[name] for name in MATRICES if self.whole}
        B, D = changes.get("B", self.model.B), changes.get("D", self.model.D)
        functions, constants = list(self.model.nonlinearities), np.zeros(B.shape[1])
        for i in self.others if self.whole else ():
            functions[i] = replace(functions[i], mu=values[f"mu {i + 1}"])
        for curve in self.curves:
            functions[curve.column] = Nonlinearity(curve.basis, values[f"mu[{curve.name}]"])
            constants[curve.column] = values[f"constant[{curve.name}]"][0]
        return replace(self.model, nonlinearities=tuple(functions), offset_x=self.model.offset_x + B @ constants,
                       offset_y=self.model.offset_y + D @ constants, gauge="none", **changes)

    def linearise(self, theta: Array) -> tuple[Array, Array]:
        """Return the whitened innovations (M,) at a point and their sensitivities (M, q), those present."""
        parts = [self._window(theta, number) for number in range(len(self.windows))]
        return np.concatenate([r for r, _ in parts]), np.vstack([s for _, s in parts])

    def _window(self, theta: Array, number: int) -> tuple[Array, Array]:
        w, model, values, q = self.windows[number], self.model_at(theta), self.unpack(theta), theta.size
        (count, l), n = w.y.shape, model.nx  # noqa: E741
        drive, direct = self._signals(theta, w, np.zeros((count, n)))
        drive[0] += self.steady.K @ w.e0
        shown = w.present.copy()
        shown[: int(w.held)] = False  # an innovation that is given does not depend on the parameters
        x = values["x0"][number] if "x0" in values else w.x0
        steady = replace(self.steady, A=model.A, C=model.C, L=np.zeros_like(model.L))
        moved, seen = -np.vstack([x, drive[:-1]])[:, :, None], np.nan_to_num(w.y - direct)[:, :, None]
        innovations = np.where(shown, steady.respond(moved, seen, shown)[..., 0], 0.0)
        still = replace(steady, C=np.eye(n), K=np.zeros((n, n)), L=np.zeros((n, n)))  # its outputs are the states
        entered = np.vstack([x, (drive + innovations @ steady.K.T)[:-1]])[:, :, None]
        states = still.respond(entered, np.zeros((count, n, 1)))[..., 0]
        here = self._signals(theta, w, states)
        into_state, into_output = np.zeros((count, n, q)), np.zeros((count, l, q))
        for j, unit in enumerate(np.eye(q)):  # exact: the signals are linear in every single unknown
            there = self._signals(theta + unit, w, states)
            into_state[1:, :, j], into_output[:, :, j] = (there[0] - here[0])[:-1], there[1] - here[1]
        if "x0" in self.slices:
            first = self.slices["x0"].start + number * n
            into_state[0, :, first : first + n] = np.eye(n)
        response: Any = steady.whiten(steady.respond(into_state, into_output, shown), shown)
        white: Any = steady.whiten(innovations, shown)
        return white[shown], -response[shown]

    def _signals(self, theta: Array, w: RefitWindow, states: Array) -> tuple[Array, Array]:
        """Return the next states (N, n) and the outputs (N, l) of the model along states (N, n)."""
        model, values = self.model_at(theta), self.unpack(theta)
        f = model.expand_inputs(w.u)
        later = states @ model.A.T + f @ model.B.T + model.offset_x + w.fed
        outputs = states @ model.C.T + f @ model.D.T + model.offset_y
        for c in self.offsets:
            course, size = c.fault_kind.progress(w.since), values[f"size[{c.label}]"]
            later[:-1] += np.outer(course[1:], c.into_state @ size)
            outputs += np.outer(course, c.into_output @ size)
        return later, outputs


def refitting(
    model: HammersteinSS, data: Data, damage: Damage, *, whole: bool = False, prior: RefitPrior | None = None,
    nodes: int = NODES,
) -> Refitting:
    """Prepare a refit from the record after a fault.

    The damaged nonlinearities are open, of the dead ones one value each, and so is what the faults add. The state at
    the onset is predicted where the plant was healthy before it.

    Args:
        model: the healthy model, with noise covariances.
        data: the record; the fault is in the first experiment from its onset on and in all of the others.
        damage: what broke, and when.
        whole: open the matrices and the other nonlinearities, too.
        prior: see `RefitPrior`.
        nodes: values of a damaged nonlinearity, where it has no nodes of its own.

    Raises:
        DataError: a missing input after the fault, an onset beyond the record, other channels than the model's.
        StructureError: no noise covariances.

    Warns:
        DataWarning: a record that is longer than what is used.
    """
    steady, raw = predictor(model), in_units_of(model, data)
    windows = tuple(_cut(model, steady, part.u, part.y, 0 if number else damage.onset, damage.same_onset)
                    for number, part in enumerate(raw.experiments))
    inputs = np.vstack([w.u[int(w.held) :] for w in windows])
    curves = tuple(curve_of(model, i, inputs, raw, nodes, i in damage.dead) for i in damage.columns)
    return Refitting(model, steady, windows, curves, damage.offsets, whole, prior or RefitPrior())


def _cut(model: HammersteinSS, steady: Predictor, u: Array, y: Array, onset: int, known_start: bool) -> RefitWindow:
    """Cut a record at the onset of a fault; the state there is predicted from the samples before."""
    if onset >= len(y):
        raise DataError(f"The onset {onset} lies beyond the record of {len(y)} samples.")
    if len(y) - onset > LONGEST:
        warnings.warn(f"Of {len(y) - onset} samples after the fault the last {LONGEST} are used.", DataWarning,
                      stacklevel=4)
        onset, known_start = len(y) - LONGEST, False
    start, before = max(onset - 1, 0), slice(max(0, onset - 4 * steady.settling), onset)
    missing = np.isnan(u[start:]).any(axis=1)
    if missing.any():
        raise DataError(f"Sample {start + int(np.argmax(missing))} lacks an input: a refit needs every input after "
                        "the onset.")
    fed = np.zeros((len(y), model.nx))
    if model.feedback or model.L.any():
        filled = interpolate_missing(y)
        fed = filled @ model.L.T
        for g, o, column in zip(model.feedback, model.output_of, model.E.T):
            fed += np.outer(g(filled[:, o]), column)
    x0, e0 = np.zeros(model.nx), np.zeros(model.l)
    known = known_start and 3 * (before.stop - before.start) >= steady.settling  # 1e-2 of an error is left
    held = known and not np.isnan(u[before]).any() and not np.isnan(y[before]).all()
    if held:
        part = Data(u[before], np.zeros(y[before].shape), model.dt, model.inputs, model.outputs)
        part = part.map_signals(lambda u: u, lambda _: y[before])  # a broken sensor has no reading at all
        white = whiten(model, part, scale=steady)
        x0, e0 = white.states[-1], np.nan_to_num(white.innovations[-1])
    after = slice(start if held else onset, None)
    return RefitWindow(u[after], y[after], ~np.isnan(y[after]), fed[after], x0, e0, held)
