"""How far a response to steps can move while time constants and dead time move within a box, for `proof`.

With a held input that moves by w_j at s_j the response is sum_j w_j S(t - s_j - theta), S the step response, which is
zero before the step and falls in all time constants and in theta: over a box it lies between those of two corners.
One pole has S = 1 - exp(-t / tau), with a kink at t = 0; on a box in which no kink lies its second derivatives are
bounded at once. Two poles have no kinks. With t_i = tau_i d/d tau_i and averages over exponentials
k_i(t) = exp(-t / tau_i) / tau_i (``*`` is convolution),

    t1 S = -q1 * k2,   t1 t1 S = p1 * k2,   t1 t2 S = q1 * (k2 - k2 * k2),   dS/dt = k1 * k2,
    dt1 S/dt = -q1' * k2,   dt2 S/dt = (q2 * k1 - q2) / tau1,   d²S/dt² = (k2 - k1 * k2) / tau1,
    q = z exp(-z),   p = z (1 - z) exp(-z),   z = t / tau,

so that second derivatives are bounded by averages of functions that do not rise, and these grow with the time constant
of the average: its largest one in the box serves for all.
"""

import numpy as np

from optid.kernel_cache import cached_njit

GONE = 300.0  # time constants after which a decay is zero: products of numbers near the smallest ones are slow
SERIES = 1e-3  # difference of the poles times the time, below which a series has more digits
P_MOST, Q_MOST, SLOPE_MOST = 0.3091, 0.3679, 0.1354  # of |p|, q, and |q'| after its zero: at z = 2.62, 1 and 2


@cached_njit
def _decay(z):
    return np.exp(-z) if z < GONE else 0.0


@cached_njit
def one_pole_courses(boxes, smooth, t, s, w):
    """Return the responses of one pole at the middles of boxes, and how far they are from there, and from tangents.

    Args:
        boxes: (B, 2, 2) log tau from, to; theta from, to.
        smooth: (B,) whether no kink lies inside.
        t: (N,) instants.
        s: (J,) times of the moves of the input.
        w: (J,) their sizes.

    Returns:
        (B, 3, N) response, its derivatives by log tau and theta; (B, N) largest distance from the response; (B, N) from
        its tangent, infinite where the box is not smooth.
    """
    count, n = len(boxes), len(t)
    x, rough, fine = np.zeros((count, 3, n)), np.zeros((count, n)), np.zeros((count, n))
    for i in range(count):
        (l1, l2), (a, b) = boxes[i]
        low_tau, high_tau, tau = np.exp(l1), np.exp(l2), np.exp((l1 + l2) / 2)
        h1, h2, theta = (l2 - l1) / 2, (b - a) / 2, (a + b) / 2
        for k in range(n):
            x0, x1, x2, wide, rest = 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(len(s)):
                since = t[k] - s[j] - theta
                if since + h2 <= 0.0:
                    continue
                size, z = abs(w[j]), max(since, 0.0) / tau
                za, zb = max(since - h2, 0.0) / high_tau, (since + h2) / low_tau
                decay, slow = _decay(z), _decay(za)
                x0 += w[j] * (1 - decay)
                wide += size * max(decay - _decay(zb), slow - decay)
                if smooth[i] and since > 0.0:
                    x1 -= w[j] * z * decay
                    x2 -= w[j] * decay / tau
                    m = max(abs(1 - za), abs(1 - zb))
                    rest += size * slow * (h1 * h1 / 2 * zb * m + h1 * h2 * m / low_tau
                                           + h2 * h2 / (2 * low_tau * low_tau))
            x[i, 0, k], x[i, 1, k], x[i, 2, k] = x0, x1, x2
            rough[i, k] = wide
            fine[i, k] = rest if smooth[i] else np.inf
    return x, rough, fine


@cached_njit
def step_of_two(t, a, b):
    """Return S, its derivatives by log a and log b, and minus that by t, at a time after the onset."""
    if t <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    first, second, c = np.exp(-t / a), np.exp(-t / b), 1 / a - 1 / b
    if abs(c * t) < SERIES:
        x = c * t
        both = second * t * (1 - x / 2 + x * x / 6 - x * x * x / 24) / (a * b)
        by_a = -second * t * t * (0.5 - x / 3 + x * x / 8 - x * x * x / 30) / (a * b)
        by_b = -first * t * t * (0.5 + x / 3 + x * x / 8 + x * x * x / 30) / (a * b)
    else:
        both = (second - first) / (c * a * b)
        by_a = -(second - (1 + c * t) * first) / (c * c * a * b)
        by_b = -(first - (1 - c * t) * second) / (c * c * a * b)
    return 1 - first - b * both, by_a, by_b, -both


@cached_njit
def _not_rising(z):
    """Return the least functions above |p|, q, |q'| and exp(-z) that do not rise, at z."""
    decay = np.exp(-z)
    p = P_MOST if z < 2.62 else z * (z - 1) * decay
    q = Q_MOST if z < 1 else z * decay
    slope = max((1 - z) * decay, SLOPE_MOST) if z < 2 else (z - 1) * decay
    return p, q, slope, decay


@cached_njit
def _average(mean, value, kept):
    """Return the average of a function over an exponential after a step in time, of which it keeps a share."""
    return kept * mean + (1 - kept) * value


@cached_njit
def _add_course(found, rough, t, move, middle, slow, fast):
    """Add the response to one move (time, size) and its derivatives (4, N), and how far (N,) it is from the corners'.

    Time constants and dead time are those in the middle of the box, its largest (slow) and its smallest ones (fast).
    """
    for k in range(len(t)):
        since = t[k] - move[0]
        if since > fast[2]:
            here = step_of_two(since - middle[2], middle[0], middle[1])
            low = step_of_two(since - slow[2], slow[0], slow[1])[0]
            high = step_of_two(since - fast[2], fast[0], fast[1])[0]
            for o in range(4):
                found[o, k] += move[1] * here[o]
            rough[k] += abs(move[1]) * max(high - here[0], here[0] - low)


@cached_njit
def _add_rest(rest, t, move, slow, fast, half):
    """Add how far (N,) the response to one move can be off its tangent: second derivatives times halves of a box.

    Functions and averages are those of the docstring of the module in units of 1 / tau: ``q1_k2`` is q1 * k2. From one
    sample to the next no function exceeds its bound at the first. Arguments as of `_add_course`; half the box's edges.
    """
    tau1, tau2, early = fast
    h1, h2, h3 = half
    p1, q1, slope1, decay1, p2, q2 = P_MOST, Q_MOST, 1.0, 1.0, P_MOST, Q_MOST
    p1_k2, q1_k2, q1_k2_k2, slope1_k2, decay1_k2, p2_k1, q2_k1 = P_MOST, Q_MOST, Q_MOST, 1.0, 1.0, P_MOST, Q_MOST
    before = np.inf
    for k in range(len(t)):
        since = t[k] - move[0]
        if since <= early:
            continue
        if since > before:
            kept1, kept2 = np.exp((before - since) / slow[0]), np.exp((before - since) / slow[1])
            q1_k2_k2 = _average(q1_k2_k2, q1_k2, kept2)
            q1_k2, q2_k1 = _average(q1_k2, q1, kept2), _average(q2_k1, q2, kept1)
            p1_k2, p2_k1 = _average(p1_k2, p1, kept2), _average(p2_k1, p2, kept1)
            slope1_k2, decay1_k2 = _average(slope1_k2, slope1, kept2), _average(decay1_k2, decay1, kept2)
        before, late = since, max(since - slow[2], 0.0)
        p1, q1, slope1, decay1 = _not_rising(late / slow[0])
        p2, q2, _, decay2 = _not_rising(late / slow[1])
        rest[k] += abs(move[1]) * (
            p1_k2 * h1 * h1 / 2 + p2_k1 * h2 * h2 / 2 + max(q1_k2, q1_k2_k2) * h1 * h2 + slope1_k2 / tau1 * h1 * h3
            + max(q2, q2_k1) / tau1 * h2 * h3 + max(decay2 / tau2, decay1_k2 / tau1) / tau1 * h3 * h3 / 2)


@cached_njit
def two_pole_courses(boxes, t, s, w):
    """Return the same as `one_pole_courses` for two poles and boxes (B, 3, 2) of log tau1, log tau2 and theta."""
    count, n = len(boxes), len(t)
    x, rough, fine = np.zeros((count, 4, n)), np.zeros((count, n)), np.zeros((count, n))
    for i in range(count):
        (a1, b1), (a2, b2), (early, late) = boxes[i]
        fast, slow = (np.exp(a1), np.exp(a2), early), (np.exp(b1), np.exp(b2), late)
        middle = np.exp((a1 + b1) / 2), np.exp((a2 + b2) / 2), (early + late) / 2
        half = (b1 - a1) / 2, (b2 - a2) / 2, (late - early) / 2
        for j in range(len(s)):
            _add_course(x[i], rough[i], t, (s[j], w[j]), middle, slow, fast)
            _add_rest(fine[i], t, (s[j], w[j]), slow, fast, half)
    return x, rough, fine
