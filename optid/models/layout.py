"""The samples in the columns of the regression y = Phi theta + e."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from optid.arrays import Array, check_integer
from optid.bases.basis import Basis
from optid.data.channels import Ports
from optid.errors import StructureError


@dataclass(frozen=True)
class Layout(Ports):
    """The columns of Phi: -y_o(k-i), i = 1..na, o inner; then per input and per lag eta(u_c(k - nk_c - j)); then 1.

    The coefficients of input c are vec(Theta_c), Theta_c (P_c, nb_c), column by column.

    Raises:
        StructureError: a negative order, or lists that do not have one entry per input.
    """

    na: int  # number of output lags
    nb: tuple[int, ...]  # number of input lags, one per input
    nk: tuple[int, ...]  # delay in samples, one per input
    bases: tuple[Basis, ...]  # one basis per input, with its interval
    outputs: tuple[str, ...]  # names of the l outputs
    inputs: tuple[str, ...]  # names of the m inputs
    n_columns: int = field(init=False, repr=False)  # number of columns of Phi
    offset: int = field(init=False, repr=False)  # column of the constant
    lags: tuple[range, ...] = field(init=False, repr=False)  # lags of every input
    group_lags: tuple[range, ...] = field(init=False, repr=False)  # of the outputs (0 is the target), of every input
    first_row: int = field(init=False, repr=False)  # first sample with a complete row: the largest lag

    def __post_init__(self) -> None:
        if not self.inputs or not self.outputs:
            raise StructureError("A model needs at least one input and one output.")
        for name, entries in (("nb", self.nb), ("nk", self.nk), ("basis", self.bases)):
            if len(entries) != self.m:
                raise StructureError(
                    f"{name} has {len(entries)} entries for {self.m} inputs ({', '.join(self.inputs)}): give one each.")
        check_integer(self.na, "na", 0)
        for channel, b, delay in zip(self.inputs, self.nb, self.nk):
            check_integer(b, f"nb of input {channel!r}")
            check_integer(delay, f"nk of input {channel!r}", 0)
        columns = self.na * self.l + sum(b * basis.size for b, basis in zip(self.nb, self.bases)) + 1
        lags = tuple(range(delay, delay + b) for b, delay in zip(self.nb, self.nk))
        found = {"n_columns": columns, "offset": columns - 1, "lags": lags, "group_lags": (range(self.na + 1), *lags),
                 "first_row": max(self.na, *(own[-1] for own in lags))}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def block(self, c: int) -> slice:
        """Return the columns of input c, whose coefficients are vec(Theta_c)."""
        sizes = [b * basis.size for b, basis in zip(self.nb, self.bases)]
        start = self.na * self.l + sum(sizes[:c])
        return slice(start, start + sizes[c])

    def names(self) -> list[str]:
        """Name every column of Phi, e.g. -y(k-1), triangular3(u(k-2)), 1."""
        names = [f"-{output}(k-{i})" for i in range(1, self.na + 1) for output in self.outputs]
        for channel, lags, basis in zip(self.inputs, self.lags, self.bases):
            family = type(basis).__name__.lower()
            for lag in lags:
                sample = f"{channel}(k-{lag})" if lag else f"{channel}(k)"
                names += [f"{family}{j}({sample})" for j in range(1, basis.size + 1)]
        return [*names, "1"]

    @cached_property
    def complete_columns(self) -> tuple[np.ndarray, ...]:
        """Columns (lags, signals) of a complete row [y lags | complete families | 1 | y] that each group takes."""
        outs, start = self.l, self.na * self.l
        groups = []
        for b, basis in zip(self.nb, self.bases):
            count = b * basis.full_size
            groups.append(np.arange(start, start + count, dtype=np.int32).reshape(b, basis.full_size))
            start += count
        past = np.arange(self.na * outs, dtype=np.int32).reshape(self.na, outs)
        return (np.vstack([np.arange(start + 1, start + 1 + outs, dtype=np.int32), past]), *groups)

    @cached_property
    def n_complete(self) -> int:
        """Length of a complete row."""
        return self.na * self.l + sum(b * basis.full_size for b, basis in zip(self.nb, self.bases)) + 1 + self.l

    def reduce_rows(self, complete: Array) -> Array:
        """Turn complete rows (K, n_complete) into rows of [Phi | Y], (K, n_columns + l)."""
        past, count = self.na * self.l, len(complete)
        parts = [-complete[:, :past]]
        for columns, basis in zip(self.complete_columns[1:], self.bases):
            family = complete[:, columns[0, 0] : columns[-1, -1] + 1].reshape(count, *columns.shape)
            parts.append((family @ basis.contrast).reshape(count, -1))
        return np.concatenate([*parts, complete[:, -1 - self.l :]], axis=1)
