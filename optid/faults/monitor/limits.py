"""Numbers of the decisions of a monitor, and its thresholds at a sample: raised outside the range and for colour."""

from dataclasses import dataclass, field

import numpy as np

from optid.arrays import Array
from optid.faults.false_alarms import common_excess
from optid.faults.monitor.events import Event

RULES = {
    "certainty": 0.98, "release": 0.5, "patience": 40.0, "settle": 10.0, "still": 10.0, "faded": 1e-8, "learned": 0.02,
    "forgiven": 0.3, "odd": 4.3, "wrong": 0.02, "beyond": 2.0, "adapt": 1.0,
}
"""Numbers of the decisions.

A fault is isolated once its posterior reaches `certainty`, or after `patience` samples. An alarm ends after `still`
samples with all statistics below `release` of their thresholds. An isolated fault is carried `settle` samples later.
A transient ends when its energy falls to `faded`. The size of a carried fault is no longer estimated once its standard
error, propagated over a window, has an energy below `learned`; the fault is cleared when its significance falls below
the share `forgiven` of the threshold. No candidate explains an alarm when the residual energy is `odd` standard
deviations too large; the signature of an uncertain model leaves a share `wrong` of the energy that it explains.

Where more windows than a tenth reach the energies that a tenth of the simulated ones reach, the noise has another
colour than that of the calibration: the thresholds are then multiplied by the ratio of these energies, by `adapt` at
most.

While an input was outside its identified range in the last window, the thresholds of an uncertain model are multiplied
by the fourth power of its distance from the middle of the range, relative to half the range, and by `beyond` at most:
what a model of a smooth plant lacks grows with the square of the distance, and its energy with the fourth power.
"""

WINDOWS = 40  # windows from which the colour of the noise is taken
CHANGED = 0.2  # least change of the logarithm of the thresholds


@dataclass(eq=False)
class Limits:
    """The thresholds and what they depend on."""

    q: Array  # (C,) as calibrated
    rules: dict[str, float]  # numbers, see `RULES`
    common: float = float("nan")  # energy over its threshold that a tenth of the simulated windows reach
    # [sample, factor] of inputs outside their range in the last window, the factors falling
    raised: list[list[float]] = field(default_factory=list)
    highest: float = 0.0  # energy over its threshold since the last multiple of the window
    windows: list[float] = field(default_factory=list)  # those of the last windows
    adapted: float = 1.0  # factor for the colour of the noise

    KEPT = "raised", "highest", "windows", "adapted"

    @property
    def thresholds(self) -> Array:
        """(C,) thresholds at this sample."""
        return self.q * (self.raised[0][1] if self.raised else 1.0) * self.adapted

    def leave_range(self, now: int, distance: float) -> None:
        """Raise the thresholds for inputs so many half ranges from the middle of their range at the sample `now`."""
        factor = min(distance**4, self.rules["beyond"])
        while self.raised and self.raised[-1][1] <= factor:
            self.raised.pop()
        self.raised.append([now, factor])

    def forget_range(self, oldest: int) -> None:
        """Discard inputs outside their range before the sample `oldest`."""
        while self.raised and self.raised[0][0] < oldest:
            self.raised.pop(0)

    def adapt(self, now: int, is_watching: bool) -> list[Event]:
        """Adapt the thresholds to the colour of the noise at the end of a window; return what has changed."""
        if is_watching or self.highest > 1:
            self.windows = [*self.windows, self.highest][-WINDOWS:]
        self.highest, factor = 0.0, 1.0
        if len(self.windows) >= WINDOWS // 2:
            factor = min(common_excess(np.array(self.windows), self.common), self.rules["adapt"])
        if abs(np.log(factor / self.adapted)) < CHANGED:
            return []
        self.adapted = factor
        note = (f"thresholds times {factor:.2f} for the colour of the noise: a fault must be {np.sqrt(factor):.2f} "
                f"times as large, or is found about {factor:.1f} times as late")
        return [Event("adapted", now, note=note)]
