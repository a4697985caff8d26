"""Two oscillating modes behind two inputs and outputs, apart or mixed, on which losses are tried out."""

from typing import TYPE_CHECKING

import numpy as np

from optid.errors import StructureError

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
    from optid.models.kalman import kalman_gain
    from optid.models.noise_covariances import NoiseCovariances

    if not (process >= 0 and measurement > 0 and np.isfinite(process + measurement)):
        raise StructureError(f"process={process}, measurement={measurement}: finite numbers, the first not negative "
                             "and the second positive, are needed.")
    a = np.zeros((4, 4))
    for i, (radius, angle) in enumerate([(0.9, 0.5), (0.8, 1.3)]):
        cosine, sine = np.cos(angle), np.sin(angle)
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = radius * np.array([[cosine, sine], [-sine, cosine]])
    if coupled:
        b, c = [[1.0, 0.2], [0, 0.5], [0.3, 1], [-0.6, 0.4]], [[1.0, 0, 0.5, 0], [0, 0.7, 0, 1]]
    else:
        b, c = [[1.0, 0], [0.5, 0], [0, 1], [0, -0.6]], [[1.0, 0, 0, 0], [0, 0, 1, 0]]
    b, c = np.array(b), np.array(c)
    q, r, s = process**2 * np.eye(4), measurement**2 * np.eye(2), np.zeros((4, 2))
    found = kalman_gain(a, c, q, r, s)
    return HammersteinSS(a, b, c, K=found.K, noise=NoiseCovariances(q, r, s, found.innovation))
