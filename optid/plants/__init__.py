"""Simulated plants: the systems on which the methods for closed loop, states and order are tried out.

Each takes an input, a seed and the sizes of its noises, and returns a record (`optid.Data`).
"""

from optid.plants.feedback import EXAMPLE1, NOISE_CASES, TWO_MODES, FeedbackSystem, two_mode_plant
from optid.plants.physical import ReactionWheelPendulum, pendulum, pendulum_input, van_der_pol, van_der_pol_drive

__all__ = ["EXAMPLE1", "NOISE_CASES", "TWO_MODES", "FeedbackSystem", "ReactionWheelPendulum", "pendulum",
           "pendulum_input", "two_mode_plant", "van_der_pol", "van_der_pol_drive"]
