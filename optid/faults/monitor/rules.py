"""Numbers of the decisions of a monitor."""

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
