"""Increased noise of one sensor, from the innovations of a window."""

from typing import Any

import numpy as np

from optid.faults.monitor.columns import Window
from optid.faults.monitor.events import Event
from optid.faults.monitor.limits import RULES

FEWEST = 4  # fewest samples of increased noise


def noisy_sensor(now: int, window: Window, outputs: tuple[str, ...]) -> Event | None:
    """Return the sensor whose noise has most likely increased; the statistic is twice the log-likelihood gained.

    More noise of one sensor increases the whitened innovations along one direction alone.
    """
    r, root = window.recent(min(int(window.clock[0]), window.length)), window.steady.root
    l, n = r.shape[1], np.arange(1, len(r) + 1)[:, None]  # noqa: E741
    along = np.cumsum((r @ (root / np.linalg.norm(root, axis=0))) ** 2, axis=0)
    share, total = along / n, np.cumsum(np.sum(r**2, axis=1))[:, None]
    alike = (l == 1) | (excess(total - along, np.maximum((l - 1) * n, 1)) < RULES["odd"])
    gain = np.where((share > 1) & (n >= FEWEST) & alike, n * (share - 1 - np.log(np.maximum(share, 1.0))), 0.0)
    if not gain.any():
        return None
    k, o = np.unravel_index(int(np.argmax(gain)), gain.shape)
    return Event("isolated", now, ((f"sensor:{outputs[o]} noise", 1.0),), now - int(k),
                 (float(np.sqrt(share[k, o])),), float(gain[k, o]), "size is the factor of the standard deviation")


def excess(energy: Any, free: Any) -> Any:
    """Return the excess of energies over chi-square with `free` degrees of freedom, in standard deviations.

    The cube root of chi2 / free is nearly Gaussian (Wilson and Hilferty 1931).
    """
    spread = 2 / (9 * free)
    return (np.cbrt(energy / free) - 1 + spread) / np.sqrt(spread)
