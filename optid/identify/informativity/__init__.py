"""What a record can tell, computed before any model: dead time, feedback, effects of inputs, excitation."""

from optid.identify.informativity.process import Process, Response, processes
from optid.identify.informativity.record import Informativity, informativity

__all__ = ["Informativity", "Process", "Response", "informativity", "processes"]
