"""The equations of a state-space model: matrices, poles, responses, forms that predict the same, content of files."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from optid.arrays import Array, finite
from optid.bases import Linear
from optid.data.channels import Transform
from optid.errors import StructureError
from optid.models import roots
from optid.models.equilibria import equilibria
from optid.models.experiments import operating_point
from optid.models.feedback_tables import tabulate
from optid.models.gauges import plant_signs
from optid.models.kalman import NoiseCovariances
from optid.models.linear import balancing, impulse_response, static_solution
from optid.models.model import Model
from optid.models.nonlinearity import Nonlinearity
from optid.models.state_signals import Parts

# shapes of the matrices: n states, m inputs, l outputs, r functions of the inputs, s of the outputs, k latent ones
MATRICES = {
    "A": "nn", "B": "nr", "C": "ln", "D": "lr", "E": "ns", "L": "nl", "K": "nl", "offset_x": "n", "offset_y": "l",
    "Ez": "nk", "Fz": "lk", "Cz": "kn", "Dz": "km", "offset_z": "k"}
COVARIANCES = {"Q": "nn", "R": "ll", "S": "nl", "innovation": "ll"}


@dataclass(frozen=True, eq=False, repr=False)
class StateSpace(Model):
    """State equations with static functions of the inputs, of the outputs and of latent signals, in raw units.

        x(k+1) = A x + B f(u) + E g(y) + L y + Ez h(z) + offset_x + K e
        y(k) = C x + D f(u) + Fz h(z) + offset_y + e,    z = Cz x + Dz u + offset_z

    With the basis `Linear`, no feedback and no latent signal this is a linear state-space model. The feedback never
    reaches the output of the same sample: there is no algebraic loop.

    Attributes:
        A: (n, n).
        B: (n, r), one column per nonlinearity of the inputs.
        C: (l, n).
        D: (l, r); zero by default, like E, L, K and the offsets.
        nonlinearities: r of them; by default the identity of every input.
        input_of: the input that each acts on, r indices; by default one per input in order.
        E: (n, s), one column per nonlinearity of the outputs.
        feedback: s of them.
        output_of: the output that each acts on, s indices; by default one per output in order.
        L: (n, l) linear output injection.
        K: (n, l) gain of the innovations; zero for an output-error model.
        offset_x: (n,) constant of the state equation.
        offset_y: (l,) constant of the output equation.
        noise: covariances of the noises, or None.
        dt, time_unit, inputs, outputs, input_units, output_units: see `Model`.
        gauge: how the scale between f and B is fixed: "norm", "gain" or "none"; see `regauge`.
        latent: k nonlinearities h of the latent signals.
        Ez: (n, k), one column per latent signal; zero by default, like the four below.
        Fz: (l, k).
        Cz: (k, n).
        Dz: (k, m).
        offset_z: (k,).
        levels: (E, l) offset_y of the experiments of its record; see `Model`.

    Raises:
        StructureError: shapes that do not agree, coefficients that are not finite, an unknown gauge, a direct
            feedthrough of g.
    """

    A: Array
    B: Array
    C: Array
    D: Any = None
    nonlinearities: tuple[Nonlinearity, ...] = ()
    input_of: tuple[int, ...] = ()
    E: Any = None
    feedback: tuple[Nonlinearity, ...] = ()
    output_of: tuple[int, ...] = ()
    L: Any = None
    K: Any = None
    offset_x: Any = None
    offset_y: Any = None
    noise: NoiseCovariances | None = None
    dt: float = 1.0
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    gauge: str = field(default="none", kw_only=True)
    time_unit: str = field(default="", kw_only=True)
    latent: tuple[Nonlinearity, ...] = field(default=(), kw_only=True)
    Ez: Any = field(default=None, kw_only=True)
    Fz: Any = field(default=None, kw_only=True)
    Cz: Any = field(default=None, kw_only=True)
    Dz: Any = field(default=None, kw_only=True)
    offset_z: Any = field(default=None, kw_only=True)
    levels: Any = field(default=None, kw_only=True)
    GAUGES = ("norm", "gain", "none")
    structure = "ss"
    memory = 0  # the initial state is estimated
    c0 = None
    offset_note = "The constants of f and g are part of the constants of the state and output equations."

    def __post_init__(self) -> None:
        fixed: dict[str, Any] = {name: finite(np.atleast_2d(getattr(self, name)), name) for name in ("A", "B", "C")}
        functions = tuple(self.nonlinearities) or (Nonlinearity(Linear(), np.ones(1)),) * fixed["B"].shape[1]
        fixed |= {"nonlinearities": functions, "feedback": tuple(self.feedback), "latent": tuple(self.latent)}
        fixed["input_of"] = tuple(int(c) for c in self.input_of) or tuple(range(len(functions)))
        fixed["output_of"] = tuple(int(o) for o in self.output_of) or tuple(range(len(fixed["feedback"])))
        m = len(self.inputs) or 1 + max(fixed["input_of"], default=-1)
        shapes = _shapes(len(fixed["A"]), m, len(fixed["C"]), len(functions), len(fixed["feedback"]),
                         len(fixed["latent"]))
        for name in (one for one in MATRICES if one not in fixed):
            given = getattr(self, name)
            absent = given is None or (0 in shapes[name] and np.size(given) == 0)
            fixed[name] = _zeros(shapes[name]) if absent else finite(given, name)
        self._fix(fixed, m, len(fixed["C"]))
        self._check(shapes)
        if self.levels is not None and (self.feedback or np.any(self.L)):
            raise StructureError("A model whose outputs are fed back has one constant for all experiments, not levels: "
                                 "the zero of a sensor acts on its states.")

    def _check(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Refuse parts that do not agree, naming the part and the shape that is needed."""
        n, outputs = self.nx, len(self.C)
        r, s, k = len(self.nonlinearities), len(self.feedback), len(self.latent)
        if self.E.shape == (n + outputs, s) and s and outputs:
            raise StructureError(
                f"E has {n + outputs} rows for {n} states: its last {outputs} would carry g(y) to the output y of the "
                "same sample, an algebraic loop. Delay the feedback by one sample: keep the first rows only.")
        for name in MATRICES:
            found, shape = getattr(self, name).shape, shapes[name]
            if found != shape:
                raise StructureError(
                    f"{name} has shape {found}; {n} states, {r} functions of the inputs, {s} of the outputs"
                    f"{f', {k} of latent signals' * bool(k)} and {outputs} outputs need {shape}.")
        for kind, where, count in (("nonlinearities", "input_of", self.m), ("feedback", "output_of", outputs)):
            functions, channels = getattr(self, kind), getattr(self, where)
            if len(functions) != len(channels) or any(not 0 <= c < count for c in channels):
                raise StructureError(
                    f"{where} = {channels}: one channel from 0 to {count - 1} for each of the {len(functions)} {kind}.")
        for kind in ("nonlinearities", "feedback", "latent"):
            for j, f in enumerate(getattr(self, kind)):
                if f.offset:
                    raise StructureError(f"{kind}[{j}] has an offset: the constants belong to offset_x and offset_y.")
        if self.noise is not None and self.noise.S.shape != shapes["S"]:
            raise StructureError(f"The noise covariance S has shape {self.noise.S.shape}; it must be {shapes['S']}.")

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def orders(self) -> dict[str, Any]:
        """The number of states nx."""
        return {"nx": self.nx}

    @cached_property
    def parts(self) -> Parts:
        """Matrices and tables as the compiled recursions read them."""
        matrices = [np.array(getattr(self, name), order="C") for name in Parts._fields[:-2]]
        functions = tabulate([*self.feedback, *self.latent])
        return Parts._make([*matrices, np.array(self.output_of, dtype=np.int64), functions])

    def expand_inputs(self, u: Array) -> Array:
        """Return the values of the r nonlinearities at the inputs u (N, m), (N, r)."""
        columns = [f(u[:, c]) for f, c in zip(self.nonlinearities, self.input_of)]
        return np.column_stack(columns) if columns else np.zeros((len(u), 0))

    # -- poles and responses -------------------------------------------------------------------------------------

    @cached_property
    def poles(self) -> Any:
        """Eigenvalues of A, complex (n,), largest first: the poles with the feedback g and L taken as given signals."""
        return roots.largest_first(np.linalg.eigvals(self.A).astype(complex))

    def equilibrium(self, u0: ArrayLike, near: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return a state (n,) and outputs (l,) at which the model rests under constant inputs u0 (m,).

        With feedback there may be several: the one that damped Newton steps find from the state `near`, zero by
        default, or else from where a free run under u0 ends.

        Raises:
            StructureError: u0 of the wrong size, a pole at 1, or no equilibrium found.
        """
        u = operating_point(self, u0)[None]
        x, y = equilibria(self, self.expand_inputs(u), u, None if near is None else np.reshape(near, (1, self.nx)))
        return x[0], y[0]

    def static_curve(self, c: int, points: Array) -> Array:
        """Return the outputs (N, l) at rest with input c held at points (N,) and the functions of the others at zero.

        A model without such a state of rest is refused (`StructureError`).
        """
        u, f = np.zeros((len(points), self.m)), np.zeros((len(points), len(self.nonlinearities)))
        u[:, c] = points
        for j in np.flatnonzero(np.equal(self.input_of, c)):
            f[:, j] = self.nonlinearities[j](points)
        return equilibria(self, f, u)[1]

    def gain_at_rest(self, u0: Array, near: ArrayLike | None = None) -> Array:
        """Return the slope (l, m) of the steady-state characteristic at an equilibrium; arguments as `equilibrium`."""
        x, y = self.equilibrium(u0, near)
        A, B, C, D = (one[0] for one in self.tangent(x[None], y[None], u0[None]))
        return D - C @ static_solution(A - np.eye(self.nx), B)

    _static_gain = gain_at_rest  # pyright: ignore[reportAssignmentType]

    def tangent(self, x: Array, y: Array, u: Array) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C, D of the free run near states (N, n), outputs (N, l) and inputs (N, m), N of each."""
        slopes = np.zeros((len(u), len(self.nonlinearities), self.m))
        for j, (f, c) in enumerate(zip(self.nonlinearities, self.input_of)):
            slopes[:, j, c] = f.slope(u[:, c])
        z = self.latent_signals(x, u)
        inner = np.array([h.slope(one) for h, one in zip(self.latent, z.T)]).T.reshape(z.shape)[:, None]
        Ez, Fz, back = self.Ez * inner, self.Fz * inner, self.output_feedback(y)
        C, D = self.C + Fz @ self.Cz, self.D @ slopes + Fz @ self.Dz
        return self.A + Ez @ self.Cz + back @ C, self.B @ slopes + Ez @ self.Dz + back @ D, C, D

    def latent_signals(self, x: Array, u: Array) -> Array:
        """Return z (N, k) at states x (N, n) and inputs u (N, m)."""
        return x @ self.Cz.T + u @ self.Dz.T + self.offset_z

    def latent_values(self, z: Array) -> Array:
        """Return h(z) (N, k) at arguments z (N, k)."""
        return np.column_stack([h(z[:, j]) for j, h in enumerate(self.latent)]) if self.latent else z

    def output_feedback(self, y: Array) -> Array:
        """Return the derivative (N, n, l) of the next state with respect to the outputs y (N, l) fed back."""
        total = np.tile(self.L, (len(y), 1, 1))
        for j, (g, o) in enumerate(zip(self.feedback, self.output_of)):
            total[:, :, o] += g.slope(y[:, o])[:, None] * self.E[:, j]
        return total

    # -- forms that predict the same -----------------------------------------------------------------------------

    def transform(self, T: ArrayLike) -> Self:
        """Return the model in the states T x; predictions do not change. T (n, n) must be invertible."""
        turn, n = np.atleast_2d(np.asarray(T, dtype=float)), self.nx
        turn = turn.reshape(0, 0) if n == 0 and turn.size == 0 else turn
        if turn.shape != (n, n) or not np.all(np.isfinite(turn)):
            raise StructureError(f"T has shape {turn.shape}; it must be a finite matrix ({n}, {n}).")
        if n and np.linalg.cond(turn) > 1e14:
            raise StructureError("T is singular; a change of states must be invertible.")
        back = np.linalg.inv(turn)
        noise = None if self.noise is None else self.noise.transform(turn, np.eye(self.l))
        moved = {name: turn @ getattr(self, name) for name in ("B", "E", "L", "K", "Ez", "offset_x")}
        return replace(self, A=turn @ self.A @ back, C=self.C @ back, Cz=self.Cz @ back, noise=noise, gauge="none",
                       **moved)

    def balance(self) -> Self:
        """Return the model in balanced states: both Gramians of (A, [B E Ez], [C; Cz]) are diagonal and equal.

        An unstable model, or one that is not minimal, is refused (`StructureError`).
        """
        return self if self.nx == 0 else self.transform(
            balancing(self.A, np.hstack([self.B, self.E, self.Ez]), np.vstack([self.C, self.Cz])))

    def inject_output(self, gain: ArrayLike) -> Self:
        """Move gain times the output out of A into L: A - gain C, L + gain, K - gain.

        P1 and P3 do not change; P2 does, since it feeds back the measured output. With a gain (n, l) of -L the
        injection is absorbed into A.
        """
        if self.levels is not None:
            raise StructureError("A model with levels feeds back no output, whose zero would act: choose a level by "
                                 "at_level first.")
        moved = np.asarray(gain, dtype=float)
        if moved.shape != self.L.shape:
            raise StructureError(f"The gain has shape {moved.shape}; it must be {self.L.shape}.")
        return replace(
            self, A=self.A - moved @ self.C, B=self.B - moved @ self.D, L=self.L + moved, K=self.K - moved,
            Ez=self.Ez - moved @ self.Fz, offset_x=self.offset_x - moved @ self.offset_y, noise=None, gauge="none")

    def _regauged(self, gauge: str, signs: bool) -> Self:
        if gauge == "gain":
            scales = self._gains()
        elif gauge == "none":
            scales = np.array([f.unit_slope for f in self.nonlinearities])
        else:
            scales = np.linalg.norm(np.vstack([self.B, self.D]), axis=0)
            scales = scales * self.gain_signs if signs else scales
        back = np.ones(self.E.shape[1])
        if gauge != "none":
            back = np.linalg.norm(self.E, axis=0)
            back = back * self._signs(self.E, np.zeros((self.l, back.size))) if signs else back
        scales, back = np.where(scales == 0, 1.0, scales), np.where(back == 0, 1.0, back)
        return replace(self, B=self.B / scales, D=self.D / scales, E=self.E / back, gauge=gauge,
                       nonlinearities=tuple(f.times(s) for f, s in zip(self.nonlinearities, scales)),
                       feedback=tuple(g.times(s) for g, s in zip(self.feedback, back)))

    @property
    def gain_signs(self) -> Array:
        """Return 1 for every function of an input with which the output rises, -1 where it falls; see `plant_signs`.

        With one output feedback does not change them, as long as the whole is stable.
        """
        return self._signs(self.B, self.D)

    def _signs(self, B: Array, D: Array) -> Array:
        matrix = np.eye(self.nx) - self.A - self.L @ self.C
        response = impulse_response(self.A, B, self.C, D, self.nx + 1)
        return plant_signs(matrix, B + self.L @ D, response, self.C, D)

    def with_signs(self, signs: ArrayLike) -> Self:
        """Multiply every function of the inputs, and its columns of B and D, by its sign (r,), 1 or -1."""
        factors = np.asarray(signs, dtype=float)
        return replace(self, B=self.B * factors, D=self.D * factors,
                       nonlinearities=tuple(f.times(sign) for f, sign in zip(self.nonlinearities, factors)))

    def _gains(self) -> Array:
        """Static gains (r,) of the linear part from every f to the output."""
        left = np.eye(self.nx) - self.A
        if self.nx and np.linalg.cond(left) > 1e12:
            raise StructureError("gauge 'gain' cannot be reached: the model has a pole at 1; use 'norm'.")
        states = np.linalg.solve(left, self.B)
        gains, sizes = self.C @ states + self.D, np.abs(self.C) @ np.abs(states) + np.abs(self.D)
        for gain, size, c in zip(gains[0], sizes[0], self.input_of):
            if not abs(gain) > 1e-9 * size:
                raise StructureError(
                    f"gauge 'gain' cannot be reached: the static gain of input {self.inputs[c]!r} is zero; use 'norm'.")
        return gains[0]

    def _in_raw_units(self, transform: Transform) -> Self:
        gain, shift = np.array(transform.y_scale), np.array(transform.y_offset)
        functions = [
            f.in_units(transform.u_scale[c], transform.u_offset[c]) for f, c in zip(self.nonlinearities, self.input_of)]
        feedback = [
            g.in_units(transform.y_scale[o], transform.y_offset[o]) for g, o in zip(self.feedback, self.output_of)]
        constants, fed = (np.array([constant for _, constant in moved]) for moved in (functions, feedback))
        # the states take the unit that all outputs share: C, and with it what a norm of B means, stays as it is then
        state = gain[0] if np.all(gain == gain[0]) else 1.0
        injection = state * self.L / gain
        inward = self.Dz / np.array(transform.u_scale)
        offset_y = gain * (self.offset_y + self.D @ constants) + shift
        return replace(
            self, B=state * self.B, C=gain[:, None] * self.C / state, D=gain[:, None] * self.D, E=state * self.E,
            L=injection, K=state * self.K / gain,
            offset_x=state * (self.offset_x + self.B @ constants + self.E @ fed) - injection @ shift,
            offset_y=offset_y,
            levels=None if self.levels is None else offset_y + gain * (self.levels - self.offset_y),
            nonlinearities=tuple(f for f, _ in functions), feedback=tuple(g for g, _ in feedback),
            noise=None if self.noise is None else self.noise.transform(state * np.eye(self.nx), np.diag(gain)),
            Ez=state * self.Ez, Fz=gain[:, None] * self.Fz, Cz=self.Cz / state, Dz=inward,
            offset_z=self.offset_z - inward @ np.array(transform.u_offset))

    def at_level(self, constant: ArrayLike) -> Self:
        """Return the model with one constant (l,) of the outputs, such as `offset_y` or a row of `levels`."""
        return replace(self, offset_y=constant, levels=None)

    def with_output_levels(self, shifts: Array) -> Self:
        """Return the model of a record whose outputs are higher by shifts (E, l) of zero mean, one an experiment."""
        return replace(self, levels=self.levels + shifts)

    @cached_property
    def with_level_states(self) -> Self:
        """The model in which the deviation of the constants of the outputs from `offset_y` are l more states.

        They do not change, and nothing acts on them. Without `levels` it is the model itself.
        """
        if self.levels is None:
            return self
        below = {name: np.vstack([getattr(self, name), np.zeros((self.l, getattr(self, name).shape[1]))])
                 for name in ("B", "E", "L", "K", "Ez")}
        return replace(self, A=block_diag(self.A, np.eye(self.l)), C=np.hstack([self.C, np.eye(self.l)]),
                       Cz=np.hstack([self.Cz, np.zeros((len(self.Cz), self.l))]), levels=None, noise=None,
                       offset_x=np.concatenate([self.offset_x, np.zeros(self.l)]), **below)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], functions: dict[str, Any] | None = None) -> Self:
        """Build the model that `to_dict` described; ``functions`` are those of a basis of UserFunctions, by name."""
        # models without latent functions may be older than those
        content = {"latent": [], **dict.fromkeys(("Ez", "Fz", "Cz", "Dz", "offset_z")), **content}
        shapes = _shapes(*(len(content[name]) for name in (
            "A", "inputs", "outputs", "nonlinearities", "feedback", "latent")))

        def read(part: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
            return {name: None if part[name] is None else np.array(part[name], dtype=float).reshape(shapes[name])
                    for name in names}

        noise = content["noise"] and NoiseCovariances(**read(content["noise"], COVARIANCES))
        return super().from_dict({**content, **read(content, MATRICES), "noise": noise}, functions)


@lru_cache
def _zeros(shape: tuple[int, ...]) -> Array:
    return finite(np.zeros(shape), "zeros")


@lru_cache
def _shapes(*sizes: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the matrices for n, m, l, r, s and k."""
    size = dict(zip("nmlrsk", sizes))
    return {name: tuple(size[letter] for letter in letters) for name, letters in (MATRICES | COVARIANCES).items()}
