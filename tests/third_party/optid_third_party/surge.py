"""A kind of fault: an actuator does more than it should, (1 + size) f(u), as an amplifier with a broken divider."""

from optid.faults.kinds import DrivenKind

SURGE = DrivenKind("surge", ("actuator",), effect=1.0, size_word="share gained")
