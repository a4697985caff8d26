"""Lower bounds for two real poles with dead time over boxes of (log tau1, log tau2, theta), for `proof`.

The step response S of two poles falls in both time constants and in theta, and has no kinks, since it begins flat. With
t_i = tau_i d/d tau_i and averages over exponentials k_i(t) = exp(-t / tau_i) / tau_i (``*`` is convolution),

    t1 S = -q1 * k2,   t1 t1 S = p1 * k2,   t1 t2 S = q1 * (k2 - k2 * k2),   dS/dt = k1 * k2,
    dt1 S/dt = -q1' * k2,   dt2 S/dt = (q2 * k1 - q2) / tau1,   d²S/dt² = (k2 - k1 * k2) / tau1,
    q = z exp(-z),   p = z (1 - z) exp(-z),   z = t / tau,

so that second derivatives are bounded by averages of functions that do not rise, and these grow with the time constant
of the average: its largest one in the box serves for all.
"""

import numpy as np

from optid.identify.process.cones import most_explained, norm, products, project
from optid.kernel_cache import cached_njit

SERIES = 1e-3  # difference of the poles times the time, below which a series has more digits


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
def two_pole_bounds(boxes, record, moves, edges):
    """Return (lower bound, V at the middle, effects of the halves of log tau1, log tau2 and theta) of boxes (B, 6).

    Other arguments as of `proof.box_bounds`.
    """
    t, y, still, base = record
    s, w = moves
    count, n = len(boxes), len(t)
    found, x = np.zeros((count, 5)), np.zeros((4, n))
    rough, fine = np.zeros(n), np.zeros(n)  # what x may differ from its middle, and from its tangent
    middle, low, high = np.zeros(4), np.zeros(4), np.zeros(4)
    energy = 0.0
    for k in range(n):
        energy += y[k] * y[k]
    for i in range(count):
        a1, b1, a2, b2 = np.exp(boxes[i, 0]), np.exp(boxes[i, 1]), np.exp(boxes[i, 2]), np.exp(boxes[i, 3])
        m1, m2 = np.exp((boxes[i, 0] + boxes[i, 1]) / 2), np.exp((boxes[i, 2] + boxes[i, 3]) / 2)
        early, late = boxes[i, 4], boxes[i, 5]
        theta = (early + late) / 2
        h1, h2, h3 = (boxes[i, 1] - boxes[i, 0]) / 2, (boxes[i, 3] - boxes[i, 2]) / 2, (late - early) / 2
        x[:] = 0.0
        rough[:] = 0.0
        fine[:] = 0.0
        x[0] = base
        for e in range(len(edges) - 1):
            for j in range(edges[e, 1], edges[e + 1, 1]):
                size, before = abs(w[j]), -1.0
                # averages p1 * k2, p2 * k1, q1 * k2, q1 * k2 * k2, q2 * k1, |q1'| * k2 and k1 * k2
                p12, p21, q12, q122, q21, r12, k12 = 0.3091, 0.3091, 0.3679, 0.3679, 0.3679, 1 / a1, 1 / a1
                p1, p2, q1, q2, r1, k1 = 0.3091, 0.3091, 0.3679, 0.3679, 1 / a1, 1 / a1
                for k in range(edges[e, 0], edges[e + 1, 0]):
                    since = t[k] - s[j]
                    if since <= early:
                        continue
                    step_of_two(since - theta, m1, m2, middle)
                    step_of_two(since - late, b1, b2, low)
                    step_of_two(since - early, a1, a2, high)
                    for o in range(4):
                        x[o, k] += w[j] * middle[o]
                    rough[k] += size * max(high[0] - middle[0], middle[0] - low[0])
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
                    fine[k] += size * (
                        p12 * h1 * h1 / 2 + p21 * h2 * h2 / 2 + max(q12, q122) * h1 * h2 + r12 * h1 * h3
                        + max(q2, q21) / a1 * h2 * h3 + max(e2 / a2, k12) / a1 * h3 * h3 / 2)
        project(x, still)
        gram, side = products(x, y)
        length = np.sqrt(gram[0, 0])
        found[i, 1] = energy - side[0] ** 2 / gram[0, 0] if length > 0.0 else energy
        e1, e2, e3 = h1 * np.sqrt(gram[1, 1]), h2 * np.sqrt(gram[2, 2]), h3 * np.sqrt(gram[3, 3])
        wide, rest = norm(rough), norm(fine)
        lower = 0.0
        if wide < length:
            lower = max(np.sqrt(max(found[i, 1], 0.0)) - np.sqrt(energy) / (length - wide) * wide, 0.0) ** 2
        change = rest + e1 + e2 + e3
        if change < length:
            least = np.sqrt(max(energy - most_explained(gram, side, np.array([h1, h2, h3])), 0.0))
            lower = max(lower, max(least - np.sqrt(energy) / (length - change) * rest, 0.0) ** 2)
        found[i, 0] = lower
        tangent = change < 2 * length
        found[i, 2], found[i, 3], found[i, 4] = (e1, e2, e3) if tangent else (h1, h2, h3)
    return found
