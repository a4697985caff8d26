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


@cached_njit
def _decay(z):
    return np.exp(-z) if z < GONE else 0.0


@cached_njit
def one_pole_courses(boxes, smooth, t, s, w):
    """Return the responses of one pole at the middles of boxes, and how far they are from there, and from tangents.

    Args:
        boxes: (B, 4) log tau from, to; theta from, to.
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
        l1, l2, a, b = boxes[i]
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
def step_of_two(t, a, b, found):
    """Write S, its derivatives by log a and log b, and minus that by t, at a time after the onset."""
    if t <= 0.0:
        found[:] = 0.0
        return
    first, second, c = np.exp(-t / a), np.exp(-t / b), 1 / a - 1 / b
    if abs(c * t) < SERIES:
        x = c * t
        both = second * t * (1 - x / 2 + x * x / 6 - x * x * x / 24) / (a * b)
        found[1] = -second * t * t * (0.5 - x / 3 + x * x / 8 - x * x * x / 30) / (a * b)
        found[2] = -first * t * t * (0.5 + x / 3 + x * x / 8 + x * x * x / 30) / (a * b)
    else:
        both = (second - first) / (c * a * b)
        found[1] = -(second - (1 + c * t) * first) / (c * c * a * b)
        found[2] = -(first - (1 - c * t) * second) / (c * c * a * b)
    found[0] = 1 - first - b * both
    found[3] = -both


@cached_njit
def two_pole_courses(boxes, t, s, w):
    """Return the same as `one_pole_courses` for two poles and boxes (B, 6) of log tau1, log tau2 and theta."""
    count, n = len(boxes), len(t)
    x, rough, fine = np.zeros((count, 4, n)), np.zeros((count, n)), np.zeros((count, n))
    middle, low, high = np.zeros(4), np.zeros(4), np.zeros(4)
    for i in range(count):
        a1, b1, a2, b2 = np.exp(boxes[i, 0]), np.exp(boxes[i, 1]), np.exp(boxes[i, 2]), np.exp(boxes[i, 3])
        m1, m2 = np.exp((boxes[i, 0] + boxes[i, 1]) / 2), np.exp((boxes[i, 2] + boxes[i, 3]) / 2)
        early, late = boxes[i, 4], boxes[i, 5]
        theta = (early + late) / 2
        h1, h2, h3 = (boxes[i, 1] - boxes[i, 0]) / 2, (boxes[i, 3] - boxes[i, 2]) / 2, (late - early) / 2
        for j in range(len(s)):
            size, before = abs(w[j]), -1.0
            # averages p1 * k2, p2 * k1, q1 * k2, q1 * k2 * k2, q2 * k1, |q1'| * k2 and k1 * k2
            p12, p21, q12, q122, q21, r12, k12 = 0.3091, 0.3091, 0.3679, 0.3679, 0.3679, 1 / a1, 1 / a1
            p1, p2, q1, q2, r1, k1 = 0.3091, 0.3091, 0.3679, 0.3679, 1 / a1, 1 / a1
            for k in range(n):
                since = t[k] - s[j]
                if since <= early:
                    continue
                step_of_two(since - theta, m1, m2, middle)
                step_of_two(since - late, b1, b2, low)
                step_of_two(since - early, a1, a2, high)
                for o in range(4):
                    x[i, o, k] += w[j] * middle[o]
                rough[i, k] += size * max(high[0] - middle[0], middle[0] - low[0])
                if before >= 0.0:  # over the time since the sample before, functions are at most what they were
                    g1, g2 = np.exp((before - since) / b1), np.exp((before - since) / b2)
                    q122 = g2 * q122 + (1 - g2) * q12
                    p12, p21 = g2 * p12 + (1 - g2) * p1, g1 * p21 + (1 - g1) * p2
                    q12, q21 = g2 * q12 + (1 - g2) * q1, g1 * q21 + (1 - g1) * q2
                    r12, k12 = g2 * r12 + (1 - g2) * r1, g2 * k12 + (1 - g2) * k1
                before = since
                z1, z2 = max(since - late, 0.0) / b1, max(since - late, 0.0) / b2
                e1, e2 = np.exp(-z1), np.exp(-z2)
                p1 = 0.3091 if z1 < 2.62 else z1 * (z1 - 1) * e1
                p2 = 0.3091 if z2 < 2.62 else z2 * (z2 - 1) * e2
                q1, q2 = 0.3679 if z1 < 1 else z1 * e1, 0.3679 if z2 < 1 else z2 * e2
                r1 = (max((1 - z1) * e1, 0.1354) if z1 < 2 else (z1 - 1) * e1) / a1
                k1 = e1 / a1
                fine[i, k] += size * (
                    p12 * h1 * h1 / 2 + p21 * h2 * h2 / 2 + max(q12, q122) * h1 * h2 + r12 * h1 * h3
                    + max(q2, q21) / a1 * h2 * h3 + max(e2 / a2, k12) / a1 * h3 * h3 / 2)
    return x, rough, fine
