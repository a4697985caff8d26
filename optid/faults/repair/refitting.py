"""What a record after a fault says of the parameters that are open: innovations and their sensitivities, compressed.

The predictor is the steady Kalman predictor of the healthy plant, started where the healthy plant was when it broke.
Its innovations are linear in the values of a damaged nonlinearity, since the columns of B and D that carry it stay; in
the other parameters they are linearised.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.bases import Linear
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError
from optid.faults.repair.curves import Curve, curve_of
from optid.faults.repair.windows import Window, cut, fed, observed
from optid.faults.signatures import Candidate
from optid.faults.whitening import Predictor, predictor
from optid.models.experiments import in_units_of
from optid.models.nonlinearity import Nonlinearity

if TYPE_CHECKING:
    from optid.models import HammersteinSS

NODES = 7
"""Values of a damaged nonlinearity that are estimated, where it has no nodes of its own."""

MATRICES = ("A", "B", "C", "D")

HELD = 1e12
"""Inverse variance of what does not move."""


@dataclass(frozen=True, eq=False)
class Prior:
    """What is believed before the record: the plant is as it was, but for what broke.

    Attributes:
        damaged: standard deviation of a value of a damaged nonlinearity about its healthy one, in halves of the range
            of the healthy nonlinearity.
        curvature: standard deviation of the second differences of its values about those of the healthy one times what
            is left of its gain, in the same units.
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
                raise StructureError(f"prior: {word} = {getattr(self, word)!r}; a positive number is needed.")


@dataclass(frozen=True, eq=False)
class Refitting:
    """A record after a fault and what is open in the model.

    Attributes:
        model: the healthy model.
        steady: its predictor; its gain is kept.
        windows: one per experiment.
        curves: the damaged nonlinearities.
        offsets: faults that add a constant or a drift, whose size is estimated along.
        whole: whether the matrices and the other nonlinearities are open, too.
        prior: what is believed beforehand.
    """

    model: "HammersteinSS"
    steady: Predictor
    windows: tuple[Window, ...]
    curves: tuple[Curve, ...]
    offsets: tuple[Candidate, ...]
    whole: bool
    prior: Prior

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the unknowns, in their order."""
        found: dict[str, tuple[int, ...]] = {}
        for curve in self.curves:
            found[f"mu[{curve.name}]"] = (curve.basis.size,)
            found[f"constant[{curve.name}]"] = (1,)
        found |= {f"size[{c.label}]": (c.into_state.shape[1],) for c in self.offsets}
        if self.whole:
            found |= {name: getattr(self.model, name).shape for name in MATRICES}
            found |= {f"mu {i + 1}": self.model.nonlinearities[i].mu.shape for i in self.others}
        if any(window.free_start for window in self.windows):
            found["x0"] = (len(self.windows), self.model.nx)
        return found

    @cached_property
    def others(self) -> tuple[int, ...]:
        """Healthy nonlinearities with a shape of their own."""
        damaged = {curve.column for curve in self.curves}
        return tuple(
            i for i, f in enumerate(self.model.nonlinearities)
            if i not in damaged and f.basis.size > 1 and not isinstance(f.basis, Linear)
        )

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each unknown lies in the vector, flattened row by row."""
        edges = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes.values())])
        return {name: slice(int(a), int(b)) for name, a, b in zip(self.shapes, edges, edges[1:])}

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return max((part.stop for part in self.slices.values()), default=0)

    @property
    def readings(self) -> int:
        """Readings after the fault."""
        return int(sum(w.present[int(w.held) :].sum() for w in self.windows))

    @property
    def samples(self) -> int:
        """Samples after the fault."""
        return int(sum(len(w.u) - int(w.held) for w in self.windows))

    def unpack(self, theta: Array) -> dict[str, Array]:
        """Return the unknowns by name."""
        return {name: theta[self.slices[name]].reshape(shape) for name, shape in self.shapes.items()}

    def pack(self, values: Any) -> Array:
        """Return the vector of unknowns given by name."""
        theta = np.empty(self.size)
        for name, part in self.slices.items():
            theta[part] = np.ravel(values[name])
        return theta

    @cached_property
    def start(self) -> Array:
        """The healthy plant as a vector of unknowns."""
        values: dict[str, Array] = {}
        for curve in self.curves:
            coefficients: Any = np.linalg.solve(curve.to_nodes, curve.healthy)
            values[f"mu[{curve.name}]"], values[f"constant[{curve.name}]"] = coefficients[:-1], coefficients[-1:]
        values |= {f"size[{c.label}]": np.zeros(c.into_state.shape[1]) for c in self.offsets}
        if self.whole:
            values |= {name: getattr(self.model, name) for name in MATRICES}
            values |= {f"mu {i + 1}": self.model.nonlinearities[i].mu for i in self.others}
        if "x0" in self.shapes:
            values["x0"] = np.array([window.x0 for window in self.windows])
        return self.pack(values)

    def spread(self) -> Array:
        """Return the standard deviations of the prior of every unknown; inf where nothing is believed."""
        spread = np.full(self.size, np.inf)
        if self.whole:
            for name in (*MATRICES, *(f"mu {i + 1}" for i in self.others)):
                values = self.start[self.slices[name]]
                spread[self.slices[name]] = self.prior.healthy * np.abs(values).max(initial=0.0)
        return spread

    def believed(self) -> tuple[Array, Array]:
        """Return what is believed beforehand: rows of a least-squares problem in [z; shares lost], and their target."""
        width = self.size + len(self.curves)
        spread = self.spread()
        finite = np.flatnonzero(np.isfinite(spread) & (spread > 0))
        rows, wanted = [np.eye(width)[finite] / spread[finite, None]], [self.start[finite] / spread[finite]]
        for i, curve in enumerate(self.curves):
            first = self.slices[f"mu[{curve.name}]"].start
            part, count, half = slice(first, first + curve.nodes.size), curve.nodes.size, curve.half_range
            near, bend = np.zeros((count, width)), np.zeros((max(count - 2, 0), width))
            near[:, part] = curve.to_nodes / (self.prior.damaged * half)
            second: Any = np.diff(np.eye(count), n=2, axis=0) / (self.prior.curvature * half)
            bend[:, part], bend[:, self.size + i] = second @ curve.to_nodes, second @ curve.healthy
            rows += [near, bend]
            wanted += [curve.healthy / (self.prior.damaged * half), second @ curve.healthy]
        return np.vstack(rows), np.concatenate(wanted)

    def evidence(self) -> float:
        """Return the log probability of the record under the prior, rules not counted, up to a constant.

        Every share lost is taken as 0.5 +- 0.5. Exact where the unknowns enter linearly.
        """
        r, s = self.linearised(self.start)
        rows, wanted = self.believed()
        shares = np.eye(self.size + len(self.curves))[self.size :] / 0.5
        rows, wanted = np.vstack([rows, shares]), np.concatenate([wanted, np.ones(len(shares))])
        full = np.column_stack([s, np.zeros((len(s), len(self.curves)))])
        before, after = rows.T @ rows, rows.T @ rows + full.T @ full
        told = rows.any(axis=0)  # the others, as an unknown initial state, have a flat prior
        before, mean = before[np.ix_(told, told)], np.zeros(len(before))
        mean[told] = np.linalg.solve(before, (rows.T @ wanted)[told])
        point = np.linalg.solve(after, rows.T @ wanted + full.T @ (s @ self.start - r))
        left = float(np.sum((full @ point - (s @ self.start - r)) ** 2) + np.sum((rows @ point - wanted) ** 2))
        left -= float(np.sum((rows @ mean - wanted) ** 2))
        return -0.5 * (left + float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]))

    def held_out(self, samples: int) -> "Refitting":
        """Return the same without the last samples of the last window."""
        last = self.windows[-1]
        kept = len(last.u) - samples
        cut = last._replace(u=last.u[:kept], y=last.y[:kept], present=last.present[:kept])
        return replace(self, windows=(*self.windows[:-1], cut))

    def information(self, theta: Array, sensitivities: Array) -> Array:
        """Return the inverse covariance (q, q) of the unknowns: of the record and of what is believed beforehand.

        Bounds are not part of it. Singular along what neither says anything of.
        """
        found = sensitivities.T @ sensitivities
        spread = self.spread()
        believed = np.isfinite(spread) & (spread > 0)
        found[believed, believed] += 1 / spread[believed] ** 2
        for curve in self.curves:
            start = self.slices[f"mu[{curve.name}]"].start
            part = slice(start, start + curve.nodes.size)  # mu, then its constant
            if curve.dead:
                shape = np.arange(start, start + curve.basis.size)
                found[shape, :], found[:, shape] = 0.0, 0.0
                found[shape, shape] = HELD
            bend = np.diff(np.eye(curve.nodes.size), n=2, axis=0) / (self.prior.curvature * curve.half_range)
            gain = bend @ curve.healthy
            if gain @ gain > 0:  # the share lost is free: curvature along that of the healthy one costs nothing
                bend = bend - np.outer(gain, gain @ bend) / (gain @ gain)
            rows = np.vstack([np.eye(curve.nodes.size) / (self.prior.damaged * curve.half_range), bend])
            rows = rows @ curve.to_nodes
            found[part, part] += rows.T @ rows
        return found

    def model_at(self, theta: Array) -> "HammersteinSS":
        """Return the model of a vector of unknowns; constants of damaged nonlinearities go to those of the model."""
        values = self.unpack(theta)
        changes: dict[str, Any] = {name: values[name] for name in MATRICES if self.whole}
        B, D = changes.get("B", self.model.B), changes.get("D", self.model.D)
        functions = list(self.model.nonlinearities)
        for i in self.others if self.whole else ():
            functions[i] = replace(functions[i], mu=values[f"mu {i + 1}"])
        offset_x, offset_y = np.array(self.model.offset_x), np.array(self.model.offset_y)
        for curve in self.curves:
            functions[curve.column] = Nonlinearity(curve.basis, values[f"mu[{curve.name}]"])
            constant = float(values[f"constant[{curve.name}]"][0])
            offset_x += B[:, curve.column] * constant
            offset_y += D[:, curve.column] * constant
        return replace(
            self.model, nonlinearities=tuple(functions), offset_x=offset_x, offset_y=offset_y, gauge="none", **changes
        )

    def linearised(self, theta: Array) -> tuple[Array, Array]:
        """Return the whitened innovations (M,) at a point and their sensitivities (M, q), those present."""
        model = self.model_at(theta)
        values = self.unpack(theta)
        parts = [self._window(model, values, number) for number in range(len(self.windows))]
        return np.concatenate([r for r, _ in parts]), np.vstack([s for _, s in parts])

    def _window(self, model: "HammersteinSS", values: dict[str, Array], number: int) -> tuple[Array, Array]:
        w = self.windows[number]
        f = model.expanded(w.u)
        drive = f @ model.B.T + model.offset_x + fed(model, w.y)
        direct = f @ model.D.T + model.offset_y
        for c in self.offsets:
            course = _course(c.kind, len(w.u), w.held)
            drive[:-1] += np.outer(course[1:], c.into_state @ values[f"size[{c.label}]"])
            direct += np.outer(course, c.into_output @ values[f"size[{c.label}]"])
        x = values["x0"][number] if "x0" in values else w.x0
        states, innovations = observed(
            model, self.steady.K, (drive, direct), w.y, x, w.e0 if w.held else None
        )
        steady = replace(self.steady, A=model.A, C=model.C, L=np.zeros_like(model.L))
        for curve in self.curves:  # its constant went to those of the model
            f[:, curve.column] += values[f"constant[{curve.name}]"]
        into_state, into_output = self._additions(model, w, f, states, number)
        shown = w.present.copy()
        shown[: int(w.held)] = False  # an innovation that is given does not depend on the parameters
        response = steady.respond(into_state, into_output, shown)
        r: Any = steady.whitened(innovations, shown)
        s: Any = steady.whitened(response, shown)
        return r[shown], -s[shown]

    def _additions(self, model: "HammersteinSS", w: Window, f: Array, states: Array, number: int
                   ) -> tuple[Array, Array]:
        """What a unit of every unknown adds to the states (N, n, q) and to the outputs (N, l, q)."""
        count, n, l = len(w.u), model.nx, model.l  # noqa: E741
        into_state, into_output = np.zeros((count, n, self.size)), np.zeros((count, l, self.size))

        def add(name: str, signal: Array, B: Array, D: Array) -> None:
            """A signal (N, k) through columns (n, k) and (l, k), or through one column."""
            part = self.slices[name]
            into_state[1:, :, part] += signal[:-1, None, :] * B
            into_output[:, :, part] += signal[:, None, :] * D

        for curve in self.curves:
            b, d = model.B[:, [curve.column]], model.D[:, [curve.column]]
            add(f"mu[{curve.name}]", curve.basis.values(w.u[:, model.input_of[curve.column]]), b, d)
            add(f"constant[{curve.name}]", np.ones((count, 1)), b, d)
        for c in self.offsets:
            course, part = _course(c.kind, count, w.held), self.slices[f"size[{c.label}]"]
            into_state[1:, :, part] += course[1:, None, None] * c.into_state
            into_output[:, :, part] += course[:, None, None] * c.into_output
        if self.whole:
            for name, signal, rows in (("A", states, n), ("B", f, n), ("C", states, l), ("D", f, l)):
                each = signal.shape[1]
                for i in range(rows):
                    first = self.slices[name].start + i * each
                    if name in "AB":
                        into_state[1:, i, first : first + each] += signal[:-1]
                    else:
                        into_output[:, i, first : first + each] += signal
            for i in self.others:
                values = model.nonlinearities[i].basis.values(w.u[:, model.input_of[i]])
                add(f"mu {i + 1}", values, model.B[:, [i]], model.D[:, [i]])
        if "x0" in self.slices:
            first = self.slices["x0"].start + number * n
            into_state[0, :, first : first + n] = np.eye(n)
        return into_state, into_output


def refitting(
    model: "HammersteinSS", data: Data, onset: int, *, damaged: Sequence[int] = (),
    offsets: Sequence[Candidate] = (), whole: bool = False, prior: Prior | None = None, nodes: int = NODES,
    known_start: bool = True, dead: Sequence[int] = (),
) -> Refitting:
    """Prepare a refit from the record after a fault.

    Args:
        model: the healthy model, with noise covariances.
        data: the record; the fault is in the first experiment from `onset` on and in all of the others.
        onset: first sample that the fault changes.
        damaged: indices of the nonlinearities of the inputs that are open.
        offsets: faults that add something, whose size is estimated along.
        whole: open the matrices and the other nonlinearities, too.
        prior: what is believed beforehand.
        nodes: values of a damaged nonlinearity, where it has no nodes of its own.
        known_start: whether the plant was healthy before the onset, so that its state there is predicted.
        dead: those of the damaged that no longer move: one constant each is estimated.

    Raises:
        DataError: a missing input after the fault, an onset beyond the record, other channels than the model's.
        RankError: fewer readings than unknowns, with the least number of samples.
        StructureError: no noise covariances.

    Warns:
        DataWarning: a record that is longer than what is used.
    """
    prior = Prior() if prior is None else prior
    steady = predictor(model)
    raw = in_units_of(model, data)
    windows = []
    for number, part in enumerate(raw.experiments):
        first = onset if number == 0 else 0
        if first >= len(part.y):
            raise DataError(f"The onset {first} lies beyond the record of {len(part.y)} samples.")
        windows.append(cut(model, steady, part.u, part.y, first, known_start))
    inputs = np.vstack([w.u[int(w.held) :] for w in windows])
    curves = tuple(replace(curve_of(model, i, inputs, raw, nodes), dead=i in dead) for i in damaged)
    found = Refitting(model, steady, tuple(windows), curves, tuple(offsets), whole, prior)
    needed = sum(1 if curve.dead else curve.nodes.size for curve in curves)
    needed += sum(c.into_state.shape[1] for c in offsets)
    if found.readings < needed:
        least = -(-needed // model.l)
        raise RankError(
            f"{found.readings} readings after the fault, and {needed} values to estimate: at least {least} samples "
            f"with every output are needed. Until then the healthy model stands as the prior."
        )
    return found


def _course(kind: str, count: int, held: bool) -> Array:
    """Course of a fault that adds something, from the first sample it changes on."""
    since = np.arange(count) - int(held)
    course = {"jump": since == 0, "drift": np.maximum(since + 1, 0)}.get(kind, since >= 0)
    return np.asarray(course, dtype=float)
