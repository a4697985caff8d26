"""Simulated plants: the systems on which the methods for closed loop, states and order are tried out.

Each takes an input and returns a record (`optid.Data`). They share these arguments, as far as they have them:

    u: (N,) or (N, m) input.
    seed: of the noises.
    process: standard deviation of the white process noise.
    measurement: standard deviation of the measurement noise.
    colour: pole of the first-order autoregression that the measurement noise is; 0 is white.
    dt: sampling time, s.
    substeps: Runge-Kutta steps per sample.
    x0: state at the first sample.

A missing input, a wrong shape and a run that leaves all bounds raise a `DataError`, a parameter out of its range a
`StructureError`.
"""

from optid.lazy import public_names
from optid.plants.feedback import EXAMPLE1, NOISE_CASES, TWO_MODES, FeedbackSystem, two_mode_plant
from optid.plants.physical import (
    TWO_TANKS,
    ReactionWheelPendulum,
    pendulum,
    pendulum_input,
    two_tanks,
    van_der_pol,
    van_der_pol_drive,
)

__all__ = ["EXAMPLE1", "NOISE_CASES", "TWO_MODES", "TWO_TANKS", "FeedbackSystem", "ReactionWheelPendulum", "pendulum",
           "pendulum_input", "two_mode_plant", "two_tanks", "van_der_pol", "van_der_pol_drive"]


__dir__ = public_names(__name__)
