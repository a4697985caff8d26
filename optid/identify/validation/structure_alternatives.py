"""The alternatives to the structure of a model: a table of names and of functions that make their columns.

Every column is a function of inputs, of the predicted output and of time alone: where the hypothesis holds, it is
independent of the noise. Sources: higher-order correlations as structure tests (Billings and Voon 1986); different
nonlinearities at different lags as a matrix of coefficients, lags times functions, of rank above one (Bai 1998).
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations_with_replacement

import numpy as np

from optid.arrays import Array
from optid.identify.validation.structure_design import Poles, denominators, filter_rational
from optid.identify.validation.structure_hypothesis import Hypothesis
from optid.models.recursions import lfilter

PRODUCTS = "products of inputs at different lags, as in a Wiener system"
RANK = "different nonlinearities at different lags"
FUNCTIONS = "functions of the inputs explain a part of the residuals"
COURSES = 4  # degree of the polynomials in time that a gain may follow
FEW = 10  # experiments up to which each may have its own gain
FAST = 0.05  # modulus of a pole that is no more than a delay
MOST = 6  # groups of poles, over all inputs, that may come before a second nonlinearity, at most
Columns = Callable[[Hypothesis], list[Array]]


def alternatives(hypothesis: Hypothesis) -> dict[str, Columns]:
    """Return functions by name that make the columns of an alternative, (N, k) per experiment."""
    own = {PRODUCTS: products, RANK: additive} if hypothesis.carriers else {FUNCTIONS: additive}
    return {
        **own,
        "functions of the output": bent_output,
        "a gain that changes with time": gain_courses,
        "functions of the output that are fed back": fed_back,
        **dict(_behind_poles(hypothesis)),
    }


def products(hypothesis: Hypothesis) -> list[Array]:
    """Products of two of all and of three of the first three carriers, and further functions of the first two."""
    found = []
    for x in _standardised(hypothesis.carriers):
        bent = 2 * np.tanh(x / 2)
        one, other = np.triu_indices(bent.shape[1])
        cubes = [a * b * c for a, b, c in combinations_with_replacement(bent.T[:3], 3)]
        found.append(np.column_stack([bent[:, one] * bent[:, other], *cubes, bent[:, 0] ** 4, bent[:, 0] ** 5,
                                      np.abs(bent[:, :2])]))
    return found


def additive(hypothesis: Hypothesis) -> list[Array]:
    """Functions of the inputs, each behind filters of its own."""
    design = hypothesis.design
    return [np.hstack([np.einsum("njp,pk->njk", bank[i], family.coarse).reshape(len(y), -1)
                       for bank, family in zip(design.banks, design.families)]) for i, y in enumerate(design.output)]


def bent_output(hypothesis: Hypothesis) -> list[Array]:
    """Functions of the output."""
    return [_bent(y) for y in _standardised(hypothesis.predicted)]


def gain_courses(hypothesis: Hypothesis) -> list[Array]:
    """The output times polynomials in time, and times one for every experiment."""
    outputs = _standardised(hypothesis.predicted)
    longest, several = max(map(len, outputs)), 1 < len(outputs) <= FEW
    found = []
    for i, y in enumerate(outputs):
        courses = [np.polynomial.legendre.legvander(2 * np.arange(len(y)) / longest - 1, COURSES)[:, 1:]]
        courses += [np.tile(np.eye(len(outputs))[i], (len(y), 1))] * several
        found.append(np.hstack(courses) * y[:, None])
    return found


def fed_back(hypothesis: Hypothesis) -> list[Array]:
    """Functions of the output through the poles of the process, at least a sample late."""
    poles = max(hypothesis.design.poles, key=len)
    return [_through(_bent(y), poles, 1) for y in _standardised(hypothesis.predicted)]


def _behind_poles(hypothesis: Hypothesis) -> Iterator[tuple[str, Columns]]:
    """Yield the dynamics before a nonlinearity, each pole and all together, for every input."""
    design = hypothesis.design
    for c, poles in enumerate(design.poles):
        factors = denominators(poles[np.abs(poles) > FAST])
        whole = [np.asarray(np.real(np.poly(poles)))] if len(factors) > 1 else []
        for a in (factors + whole)[: max(MOST // len(design.poles), 1)]:
            size = f"{np.abs(np.roots(a)).max():.2g}"
            word = f"functions of {design.data.inputs[c]!r} behind {'all poles' if a is whole else 'poles'} at {size}"
            yield word, partial(behind, c=c, denominator=a)


def behind(hypothesis: Hypothesis, c: int, denominator: Array) -> list[Array]:
    """Functions of an input behind some poles, through all of them."""
    design = hypothesis.design
    signals = [lfilter([1.0], denominator, u[:, c] - u[0, c]) for u in design.inputs]
    return [_through(_bent(x), design.poles[c], design.lags[c]) for x in _standardised(signals)]


def _bent(x: Array) -> Array:
    """Square, cube, modulus and signed square of a standardised signal, which saturates, (N, 4)."""
    bent = 2 * np.tanh(x / 2)
    return np.column_stack([bent**2, bent**3, np.abs(bent), bent * np.abs(bent)])


def _through(values: Array, poles: Poles, lag: int) -> Array:
    found = filter_rational(values - values[:1], poles, lag, pulses=2, twice=False)
    return found.reshape(len(found), -1)


def _standardised(signals: Sequence[Array]) -> list[Array]:
    """Return signals, (N,) or (N, q) per experiment, with mean zero and variance one over all experiments."""
    whole = np.concatenate(signals)
    middle, spread = whole.mean(axis=0), np.maximum(whole.std(axis=0), 1e-300)
    return [(x - middle) / spread for x in signals]
