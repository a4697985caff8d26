"""The unknowns of the step for B, D, E, offset and x0 by name: where a search starts, and how its answer is read."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.bases import Linear
from optid.identify.subspace.observer import ObserverProblem
from optid.structures.bilinear import starts
from optid.structures.rank_one import reduce
from optid.structures.whitening import leading_pair

Values = Mapping[str, Array]


class Factors(NamedTuple):
    """What the step answers.

    Attributes:
        B: (n, m).
        D: (l, m).
        E: (n, s), one column per feedback family.
        mus: coefficients of the nonlinearity of every input.
        nus: coefficients of every feedback family in its orthonormal coordinates.
        offset: (l,).
    """

    B: Array
    D: Array
    E: Array
    mus: list[Array]
    nus: list[Array]
    offset: Array


@dataclass(frozen=True, eq=False)
class Realisation:
    """The step in named unknowns: one pair of factors per channel, or one matrix.

    Attributes:
        step: the compressed least squares.
        factored: whether channels are rank one in the programme itself.
    """

    step: ObserverProblem
    factored: bool

    def names(self, i: int) -> tuple[str, str, str]:
        """Names of the two factors and of the matrix of channel i: ``mu[valve]``, ``mu feedback[level]``."""
        x = self.step.form.expansion
        if i < x.m:
            kind, several, channel = "", x.m > 1, x.input_names[i]
        else:
            kind, several, channel = " feedback", x.l > 1, x.output_names[x.feedback[i - x.m].output]
        mu, b, theta = (f"{name}{kind}[{channel}]" if several else name + kind for name in ("mu", "b", "Theta"))
        return mu, b, theta

    def start(self) -> dict[str, Array]:
        """Return the unrestricted minimiser; of factored channels the most promising factors.

        Raises:
            RankError: naming what the record does not determine.
        """
        step, form = self.step, self.step.form
        z = step.least_squares()
        point = None
        if self.factored:
            core = reduce(step.problem)
            point = core.point(*starts(core, count=1)[0])
        linear = z[: step.problem.linear] if point is None else point.w
        states = form.n * form.experiments
        x0 = linear[:states] if form.experiments == 1 else linear[:states].reshape(form.n, form.experiments, order="F")
        found = {"x0": np.array(x0)} | ({"offset": np.array(linear[states:])} if form.offset else {})
        for i, (p, b) in enumerate(form.blocks):
            mu, entries, theta = self.names(i)
            if point is None:
                found[theta] = z[form.block(i)].reshape((p, b), order="F")
            else:
                empty = not np.any(point.bs[i])
                found[mu] = np.zeros(p) if empty else point.mus[i]
                found[entries] = np.full(b, 1 / np.sqrt(b)) if empty else point.bs[i]
        return found

    def factors(self, values: Values) -> Factors:
        """Read a point; a matrix is split in the Kronecker metric of the least squares."""
        form, pairs, core = self.step.form, [], None
        x = form.expansion
        for i, shape in enumerate(form.blocks):
            first, second, whole = self.names(i)
            if first in values:
                mu, b = np.asarray(values[first]), np.asarray(values[second])
            else:
                theta = np.reshape(values[whole], shape)
                core = core or reduce(self.step.problem)
                if i in core.kept:
                    place = core.kept.index(i)
                    mu, b = leading_pair(theta, core.whitening.factors_mu[place], core.whitening.factors_b[place])
                else:
                    mu, b = (np.ones(1), theta[0]) if shape[0] == 1 else (theta[:, 0], np.ones(1))
            pairs.append(_oriented(mu, b, linear=i < x.m and isinstance(x.inputs[i], Linear)))
        n, l, m = form.n, form.l, x.m  # noqa: E741
        mus, bs = [mu for mu, _ in pairs], [b for _, b in pairs]
        direct = [b[n:] if len(b) > n else np.zeros(l) for b in bs[:m]]
        return Factors(np.column_stack([b[:n] for b in bs[:m]]), np.column_stack(direct),
                       np.column_stack([np.zeros((n, 0)), *bs[m:]]), mus[:m], mus[m:],
                       np.asarray(values["offset"]) if form.offset else np.zeros(l))


def _oriented(mu: Array, b: Array, *, linear: bool) -> tuple[Array, Array]:
    """A linear channel has mu = 1; every other a b of unit length, its largest entry positive."""
    if linear:
        return np.ones(1), b * mu[0]
    length = float(np.linalg.norm(b))
    if length == 0.0:
        return np.zeros_like(mu), np.full(len(b), 1 / np.sqrt(len(b)))
    length *= float(np.sign(b[int(np.argmax(np.abs(b)))]))
    return mu * length, b / length
