"""Two oscillating modes behind two inputs and outputs, apart or mixed, on which losses are tried out."""

from typing import TYPE_CHECKING

import numpy as np

from optid.errors import StructureError
from optid.plants.feedback import TWO_MODES, rotation

if TYPE_CHECKING:
    from optid.models.hammerstein_ss import HammersteinSS


def two_mode_plant(coupled: bool = False, process: float = 0.0, measurement: float = 0.1) -> "HammersteinSS":
    """Return a linear plant of order 4 without feedthrough, poles of radius 0.9 and 0.8, with white noise.

    Args:
        coupled: False: input i, mode i, output i, so that a loss hides a mode; True: every channel sees both modes.
        process: standard deviation of the process noise on every state.
        measurement: standard deviation of the measurement noise on every output.

    Raises:
        StructureError: a negative deviation, or no measurement noise.
    """
    from optid.models.hammerstein_ss import HammersteinSS
    from optid.models.kalman import NoiseCovariances, kalman_gain

    if not (process >= 0 and measurement > 0 and np.isfinite(process + measurement)):
        raise StructureError(f"process={process}, measurement={measurement}: finite numbers, the first not negative "
                             "and the second positive, are needed.")
    nothing = np.zeros((2, 2))
    a = np.block([[rotation(0.9, 0.5), nothing], [nothing, rotation(0.8, 1.3)]])
    if coupled:
        b, c = TWO_MODES.b, TWO_MODES.c
    else:
        b, c = np.array([[1.0, 0], [0.5, 0], [0, 1], [0, -0.6]]), np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
    q, r, s = process**2 * np.eye(4), measurement**2 * np.eye(2), np.zeros((4, 2))
    found = kalman_gain(a, c, q, r, s)
    return HammersteinSS(a, b, c, K=found.K, noise=NoiseCovariances(q, r, s, found.innovation))
