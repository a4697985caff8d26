"""Charts of the frequency domain: the Nyquist curve, and poles and zeros, with the regions that the record leaves them.

The regions are 95 % ellipses of two coordinates that are estimated together, and 95 % intervals of a real pole or zero.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import OptidError
from optid.identify.dynamics import Levels, mean_slopes, nearest_real
from optid.models.functions import response_pairs, static_functions
from optid.show.charts import CIRCLE, COLOURS, frequencies, ratio_unit
from optid.show.sections import Axis, Chart, Series

SPREAD = float(np.sqrt(-2 * np.log(0.05)))  # radius of a 95 % ellipse, in standard deviations
MARKED = 12  # frequencies whose regions are drawn
FAR = 2.0  # zeros further out than this, in radii of the picture of the poles, are named instead of drawn
RISING = 1.5  # ratio of the first response to that of a tenth of the frequencies, above which the model integrates
STEEP, TALL = 10.0, 3.0  # an integrator is drawn up to so many medians, and so many widths of the picture


def pole_zero_chart(model: Any, known: Any = None) -> Chart:
    """Draw poles and zeros of a model, with their regions where its uncertainty is known."""
    sampled = hasattr(model, "dt")
    radius = max(1.0 if sampled else 0.0, float(np.abs(model.poles).max(initial=0.0))) or 1.0
    zeros: Any = model.zeros
    near, away, series = zeros[np.abs(zeros) <= FAR * radius], zeros[np.abs(zeros) > FAR * radius], []
    if sampled:
        series.append(Series("", *CIRCLE, "line-only", "muted", width=1.2))
    for name, kind, roots, colour in (("poles", "poles", model.poles, "c0"), ("zeros", "zeros", near, "c1")):
        if known is not None:
            for root in roots[roots.imag >= 0]:
                series += _root_regions(name, root, known, colour)
        if len(roots):
            series.append(Series(name, roots.real, roots.imag, kind, colour))
    if away.size:
        named = ", ".join(f"{zero.real:.3g}" if zero.imag == 0 else f"{zero:.3g}" for zero in away)
        series.append(Series(f"not shown: zeros at {named}", np.zeros(0), np.zeros(0), "zeros", "muted"))
    reach = 1.15 * max(radius, float(np.abs(near).max(initial=0.0)))
    unit = f" (1/{model.time_unit})" * (not sampled and bool(model.time_unit))
    where = "inside the unit circle" if sampled else "in the left half-plane"
    caption = f"A stable model has its poles {where}" + ("; with 95 % regions." if known is not None else ".")
    right = reach if sampled or max(model.poles.real.max(initial=0), near.real.max(initial=0)) > 0 else 0.15 * reach
    across = Axis(f"real part{unit}", low=-reach, high=right)
    return Chart("Poles and zeros", caption, across, Axis(f"imaginary part{unit}", low=-reach, high=reach), series,
                 equal=True)


def _root_regions(name: str, root: complex, known: Any, colour: str) -> list[Series]:
    """Return the region of a real root, or of a pair, as lines; none where they nearly coincide with others."""
    if root.imag == 0:
        found = _interval(known, lambda model: nearest_real(getattr(model, name), root.real))
        if found is None or not np.isfinite([found.lower, found.upper]).all():
            return []
        ends = np.array([found.lower, found.upper], dtype=float)
        return [Series("", ends, np.zeros(2), "line-only", colour, width=5.0)]

    def pair(model: Any) -> Array:
        roots = getattr(model, name)
        nearest = roots[np.argmin(np.abs(roots - root))] if len(roots) else complex(np.nan)
        return np.array([[nearest.real, nearest.imag]])

    return [Series("", x, sign * y, "line-only", colour, width=1.2)
            for x, y in ellipses(known, pair) for sign in (1, -1)]


def nyquist_chart(model: Any, levels: Levels, known: Any = None) -> Chart:
    """Draw the frequency response in the complex plane, with regions at some frequencies where they are known.

    A nonlinear f counts with its range over that of its input, between two levels of every input.
    """
    w = frequencies(model, 400)
    response = (model.frequency_response(w) * mean_slopes(model, levels)).reshape(w.size, -1)
    shown = _is_in_picture(response)
    w, response = w[shown], response[shown]
    moved = np.abs(np.diff(response, axis=0)) / np.maximum(np.abs(response).max(axis=0), 1e-300)
    way = np.concatenate([[0.0], np.cumsum(moved.sum(axis=1))])
    marks = np.unique(np.searchsorted(way, np.linspace(0, way[-1], MARKED)))  # evenly along the curves
    series, pairs = [], response_pairs(model)
    for k, (u, y) in enumerate(pairs):
        if not response[:, k].any():
            continue
        colour = COLOURS[k % len(COLOURS)]
        if known is not None:
            def at_marks(model: Any, k: int = k) -> Array:
                values = (model.frequency_response(w[marks]) * mean_slopes(model, levels)).reshape(marks.size, -1)[:, k]
                return np.column_stack([values.real, values.imag])

            series += [Series("", x, values, "line-only", colour, width=1.0) for x, values in ellipses(known, at_marks)]
        curve, name = response[:, k], f"{u} to {y}" if len(pairs) > 1 else "response"
        series.append(Series(name, curve.real, curve.imag, "line-only", colour, width=2.0))
        series.append(Series("", curve[marks].real, curve[marks].imag, "dots", colour))
    bent = any(not function.is_linear for function in static_functions(model))
    caption = (f"From {w[0]:.3g} to {w[-1]:.3g} rad per unit of time" + ", with the mean slope of f" * bent
               + (f"; 95 % regions at {marks.size} frequencies." if known is not None else "."))
    unit = f" ({unit})" if (unit := ratio_unit(model)) else ""
    return Chart("Nyquist curve", caption, Axis(f"real part{unit}"), Axis(f"imaginary part{unit}"), series, equal=True)


def _is_in_picture(response: Array) -> Any:
    """Tell the frequencies (k,) to draw of a response (k, pairs): without the far branch of an integrator."""
    size = np.abs(response).max(axis=1)
    if not size[0] > RISING * size[size.size // 10]:
        return np.full(size.size, True)
    shown = size <= STEEP * np.median(size)
    across = float(np.abs(response[shown].real).max(initial=0.0))
    return shown & (size <= TALL * across) if np.count_nonzero(size <= TALL * across) > MARKED else shown


def ellipses(known: Any, quantity: Callable[[Any], Array]) -> list[tuple[Array, Array]]:
    """Return the 95 % ellipses of pairs of numbers (k, 2), functions of the model; none where there is no error.

    The covariance of two numbers follows from the error of their sum, each in its own standard deviations.
    """
    single = _interval(known, quantity)
    if single is None:
        return []
    sizes = np.where(single.error > 0, single.error, np.inf)
    both = _interval(known, lambda model: (quantity(model) / sizes).sum(axis=1))
    found = []
    for (x, y), (sx, sy), total in zip(single.value, single.error, both.error if both is not None else []):
        if not np.isfinite([sx, sy, total]).all():
            continue
        rho = float(np.clip(total**2 / 2 - 1, -1, 1)) if sx > 0 and sy > 0 else 0.0
        turned = rho * CIRCLE[0] + np.sqrt(1 - rho**2) * CIRCLE[1]
        found.append((x + SPREAD * sx * CIRCLE[0], y + SPREAD * sy * turned))
    return found


def _interval(known: Any, quantity: Callable[[Any], Any]) -> Any:
    """Return the interval of a quantity; None where it has none."""
    try:
        return known.of(quantity)
    except OptidError:
        return None
