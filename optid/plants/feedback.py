"""Systems of a few states with two inputs and outputs: nonlinear feedback of outputs, and two lightly damped modes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.data.record import Data
from optid.plants.sampling import as_input, as_state, check_bounded, check_parameters, gaussian

if TYPE_CHECKING:
    from optid.models.hammerstein_ss import HammersteinSS


@dataclass(frozen=True, eq=False)
class FeedbackSystem:
    """x+ = A x + B f(u) + E g(y) + w, y = C x + D f(u) + v, with the measured output in the feedback.

    g(y) = (-sin y1, -y2 |y2| / (1 + y2^2)); with E = 0 there is no feedback.

    Attributes:
        a: (n, n).
        b: (n, 2).
        c: (2, n).
        d: (2, 2).
        e: (n, 2).
        f: the input nonlinearities, one function per input.
        name: name of its records.
    """

    a: Array
    b: Array
    c: Array
    d: Array
    e: Array
    f: tuple[Callable[[Array], Array], ...]
    name: str

    def __post_init__(self) -> None:
        for matrix in (self.a, self.b, self.c, self.d, self.e):
            matrix.flags.writeable = False

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.a)

    def record(self, u: ArrayLike, seed: int | np.random.Generator = 0, *, process: float = 0.0,
               measurement: float = 0.0, colour: float = 0.0, x0: ArrayLike | None = None) -> Data:
        """Simulate a record under inputs u (N, 2); the arguments are those of `optid.plants`, x0 zero by default."""
        from optid.plants.kernels import with_feedback

        u = as_input(u, 2)
        rng = np.random.default_rng(seed)
        w = gaussian(rng, len(u), self.order, process, 0.0, "process")
        v = gaussian(rng, len(u), 2, measurement, colour, "measurement")
        fu = np.column_stack([f(u[:, i]) for i, f in enumerate(self.f)])
        direct = fu @ self.d.T
        start = as_state(np.zeros(self.order) if x0 is None else x0, self.order)
        states = with_feedback(self.a, fu @ self.b.T + w, direct, self.c, self.e, v, start)
        check_bounded(states, self.name)
        return Data(u, states @ self.c.T + direct + v, name=self.name)


def _cubic(u: Array) -> Array:
    return u + 0.5 * u**3


def _tanh(u: Array) -> Array:
    return np.tanh(2 * u)


def rotation(radius: float, angle: float) -> Array:
    """Return the (2, 2) matrix with the poles radius exp(+- i angle)."""
    cosine, sine = radius * np.cos(angle), radius * np.sin(angle)
    return np.array([[cosine, sine], [-sine, cosine]])


EXAMPLE1 = FeedbackSystem(
    a=np.array([[0.7, 0.35, 0.0], [-0.35, 0.7, 0.1], [0.0, 0.0, 0.5]]),
    b=np.array([[1.0, 0.2], [0.0, 0.8], [0.5, -0.6]]),
    c=np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]]),
    d=np.zeros((2, 2)),
    e=np.array([[0.4, 0.0], [-0.2, 0.3], [0.1, 0.5]]),
    f=(_cubic, _tanh),
    name="example1",
)
"""Order 3, f = (u1 + 0.5 u1^3, tanh 2 u2); meant for inputs within 2."""

TWO_MODES = FeedbackSystem(
    a=np.block([[rotation(0.9, 0.5), np.zeros((2, 2))], [np.zeros((2, 2)), rotation(0.75, 1.4)]]),
    b=np.array([[1.0, 0.2], [0.0, 0.5], [0.3, 1.0], [-0.6, 0.4]]),
    c=np.array([[1.0, 0.0, 0.5, 0.0], [0.0, 0.7, 0.0, 1.0]]),
    d=np.diag([0.1, 0.2]),
    e=np.zeros((4, 2)),
    f=(np.positive, np.positive),
    name="two_modes",
)
"""Order 4, linear: modes of radius 0.9 and 0.75 at 0.5 and 1.4 rad per sample."""

NOISE_CASES: dict[str, tuple[float, float]] = {
    "deterministic": (0.0, 0.0),
    "measurement": (0.0, 0.1),
    "combined": (0.05, 0.2),
    "strong": (0.2, 0.5),
}
"""(process, measurement) noise of the order-estimation examples on `TWO_MODES`."""


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

    check_parameters(positive=False, process=process)
    check_parameters(measurement=measurement)
    nothing = np.zeros((2, 2))
    a = np.block([[rotation(0.9, 0.5), nothing], [nothing, rotation(0.8, 1.3)]])
    if coupled:
        b, c = TWO_MODES.b, TWO_MODES.c
    else:
        b, c = np.array([[1.0, 0], [0.5, 0], [0, 1], [0, -0.6]]), np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
    q, r, s = process**2 * np.eye(4), measurement**2 * np.eye(2), np.zeros((4, 2))
    found = kalman_gain(a, c, q, r, s)
    return HammersteinSS(a, b, c, K=found.K, noise=NoiseCovariances(q, r, s, found.innovation))
