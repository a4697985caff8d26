"""Hammerstein state-space models run over records: the three simulators and their initial states."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from optid.arrays import Array, one_or_all
from optid.data.record import Data
from optid.errors import DataError
from optid.models import state_simulation as simulation
from optid.models import text
from optid.models.continuous import ContinuousModel
from optid.models.experiments import Record, records_of
from optid.models.state_space import StateSpace


class HammersteinSS(StateSpace):
    """A state-space model that predicts and simulates records; its arguments are those of `StateSpace`."""

    SIMULATORS = simulation.SIMULATORS
    equation, coefficients = text.state_equations, text.matrix_entries

    @property
    def _state_shape(self) -> tuple[int]:
        return (self.with_level_states.nx,)

    def _predicted(self, u: Array, y: Array, horizon: int, state: Array, label: str) -> Array:
        return simulation.run(simulation.prepare_run(self.with_level_states, "predict", u, y, None, label), state,
                              horizon)

    def simulate_measured_feedback(self, data: Data, x0: Any = "zero") -> Any:
        """Simulate with the measured outputs in the feedback (P2), without correcting the state; see `simulate`.

        Where an output is missing the model's own output is fed back. Inputs without outputs are refused
        (`StructureError`).
        """
        return one_or_all(self._run("measured_feedback", records_of(self, data)[0], x0))

    def _run(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        states, limits = self._states(simulator, records, x0), simulation.allowed_range([y for _, y, _ in records])
        if not self.feedback and not np.any(self.L):
            self._warn_unstable()
        return [simulation.run(simulation.prepare_run(self.with_level_states, simulator, u, y, limits, label), x)
                for (u, y, label), x in zip(records, states)]

    def _fitted(self, simulator: str, u: Array, y: Any, label: str) -> Array:
        """Fit the initial state of one record; a free run with feedback starts from the value of P2, or from rest."""
        limits = simulation.allowed_range([y]) if self.feedback and simulator != "predict" else None
        run = simulation.prepare_run(self.with_level_states, simulator, u, y, limits, label)
        if self.feedback and simulator == "free":
            measured = simulation.prepare_run(self, "measured_feedback", u, y, None, label)
            try:
                return simulation.fitted_state(run, y, simulation.fitted_state(measured, y))
            except DataError:
                pass
        return simulation.fitted_state(run, y)

    def latent_run(self, data: Data) -> list[Array]:
        """Return the latent signals (N, k) of every experiment in the free run from the initial state that fits best.

        A run that leaves 100 times the range of the record raises a `DataError`.
        """
        records = records_of(self, data)[0]
        limits = simulation.allowed_range([y for _, y, _ in records])
        model = self.with_level_states
        runs = [simulation.prepare_run(model, "free", u, y, limits, label) for u, y, label in records]
        states = self._states("free", records, "fit")
        return [model.latent_signals(simulation.run_states(run, x), run.u) for run, x in zip(runs, states)]


ContinuousModel.SAMPLED = HammersteinSS
