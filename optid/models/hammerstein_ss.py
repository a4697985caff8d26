"""Hammerstein state-space models run over records: the three simulators and their initial states."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.data.stretches import between_gaps
from optid.errors import DataError, StructureError
from optid.models import export, state_text
from optid.models import state_simulation as simulation
from optid.models.experiments import Record, checked_horizon, one_or_all, records_of, states_of
from optid.models.files import KINDS
from optid.models.state_space import StateSpace


class HammersteinSS(StateSpace):
    """A state-space model that predicts and simulates records; its arguments are those of `StateSpace`."""

    def equation(self, digits: int = 4) -> str:
        """Write the model as equations: one per state up to four states, in matrices with the poles beyond."""
        return state_text.written(self, digits)

    def coefficients(self) -> list[tuple[str, float]]:
        """Return (name, value) of the entries of all matrices, as tables show them; zero matrices are left out."""
        return state_text.listed(self)

    def predict(self, data: Data, horizon: int = 1, x0: Any = "fit") -> Any:
        """Predict with the innovation form (P1): every output up to `horizon` samples before is known.

        A missing output corrects nothing, and its feedback sees the prediction instead. After a missing input the
        state is not known: the stretches in between are predicted each from an initial state of its own, and short
        ones not at all.

        Args:
            data: the record; detrended or scaled data are taken back to raw units first.
            horizon: how many samples ahead; the inputs are known always.
            x0: "fit" (least squares of the one-step errors), "zero", or the state (n,), one for each experiment.

        Returns:
            (N, l) in raw units, NaN in the first horizon - 1 samples and where inputs leave no prediction; a tuple of
            such arrays for several experiments.

        Raises:
            DataError: no stretch with every input, other channels or sampling time, predictions that leave the range
                of numbers.
            StructureError: a horizon that is not a positive integer, or an x0 that cannot be read.
        """
        horizon = checked_horizon(horizon)
        if isinstance(data, Data) and any(np.isnan(e.u).any() for e in data.experiments):
            return self._predicted_between_gaps(data, horizon, x0)
        records, _ = records_of(self, data)
        runs, states = self._runs("predict", records), self._states("predict", records, x0)
        return one_or_all([simulation.ahead(run, x, horizon) for run, x in zip(runs, states)])

    def _predicted_between_gaps(self, data: Data, horizon: int, x0: Any) -> Any:
        if not isinstance(x0, str):
            raise StructureError("inputs are missing, and no state is known after such a gap: use x0='fit' or 'zero'")
        raw = data.raw()
        cut, places = between_gaps(raw, 2 * self.nx + 1)
        stretches = self.predict(cut, horizon, x0)
        found = [np.full(e.y.shape, np.nan) for e in raw.experiments]
        for (experiment, part), predicted in zip(places, stretches if isinstance(stretches, tuple) else (stretches,)):
            found[experiment][part] = predicted
        return one_or_all(found)

    def simulate_measured_feedback(self, data: Data, x0: Any = "zero") -> Any:
        """Simulate with the measured outputs in the feedback (P2), without correcting the state.

        Where an output is missing the model's own output is fed back. Without feedback this is `simulate`.

        Args:
            data: the record; detrended or scaled data are taken back to raw units first.
            x0: "zero", "fit" (least squares on the outputs present), or the state (n,), one for each experiment.

        Returns:
            (N, l) in raw units; a tuple of such arrays for several experiments.

        Raises:
            DataError: as `simulate`.
            StructureError: an x0 that cannot be read, or inputs without outputs.

        Warns:
            DataWarning: the model is unstable.
        """
        return one_or_all(self._run("measured_feedback", records_of(self, data)[0], x0))

    def _run(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        runs, states = self._runs(simulator, records), self._states(simulator, records, x0)
        if not self.feedback and not np.any(self.L):
            self._warn_unstable()
        return [simulation.run(run, x) for run, x in zip(runs, states)]

    def _runs(self, simulator: str, records: Sequence[Record]) -> list[simulation.Run]:
        """Return what a simulator runs over, one for each record."""
        if simulator not in simulation.SIMULATORS:
            raise StructureError(f"simulator={simulator!r}: use one of {', '.join(simulation.SIMULATORS)}.")
        if simulator != "free" and any(y is None for _, y, _ in records):
            raise StructureError("This simulator needs the outputs: pass Data, or call simulate.")
        limits = None if simulator == "predict" else simulation.allowed_range([y for _, y, _ in records])
        return [simulation.prepared(self, simulator, u, y, limits, label) for u, y, label in records]

    def _states(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        runs = self._runs(simulator, records)
        return states_of(records, x0, (self.nx,), lambda i: self._fitted(runs[i], records[i][1]))

    def _fitted(self, run: simulation.Run, y: Any) -> Array:
        """Fit the initial state of one run; a free run with feedback starts from the value of P2, or from rest."""
        unbounded = simulation.prepared(self, "free", run.u, None, None, run.label)
        if not self.feedback:
            return simulation.fitted_state(run._replace(low=unbounded.low, high=unbounded.high), y)
        if run.known is None:
            try:
                return simulation.fitted_state(run, y, simulation.fitted_state(unbounded._replace(known=y), y))
            except DataError:
                pass
        return simulation.fitted_state(run, y)

    def to_dlti(self) -> Any:
        """Return (A, B, C, D), from every f to every output, as a `scipy.signal.dlti`."""
        from scipy.signal import dlti

        return dlti(self.A, self.B, self.C, self.D, dt=self.dt)

    def to_control(self) -> Any:
        """Return (A, B, C, D), from every f to every output, as a python-control system."""
        return export.control_package().ss(self.A, self.B, self.C, self.D, self.dt)

    def to_casadi(self) -> Any:
        """Return (x, u) -> (x_next, y) as a `casadi.Function`, the free run without noise."""
        return export.state_space_to_casadi(self)


KINDS["HammersteinSS"] = HammersteinSS.from_dict
