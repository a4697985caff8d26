"""What a record can tell, computed before any model: dead time, feedback, effects of inputs, excitation."""

from optid.identify.informativity.process import DelayedResponse, Process, processes
from optid.identify.informativity.record import Informativity, informativity

__all__ = ["Informativity", "Process", "DelayedResponse", "informativity", "processes"]
