"""Independent routes for rank-one least squares: the exact one-dimensional search for n_b = 2, and small problems."""

import numpy as np
from scipy.optimize import minimize_scalar

from optid.structures.rank_one import RankOne


def direction_value(problem: RankOne, b: np.ndarray) -> float:
    """Objective minimised over w and mu for a fixed direction b of the only block, by dense least squares."""
    p, nb = problem.blocks[0]
    n = problem.linear
    design = np.hstack([problem.root[:, :n], problem.root[:, n:] @ np.kron(b[:, None], np.eye(p))])
    solution = np.linalg.lstsq(design, problem.target, rcond=None)[0]
    return float(np.sum((design @ solution - problem.target) ** 2)) + problem.remainder


def search_circle(problem: RankOne, points: int = 720) -> float:
    """Global minimum for one block with n_b = 2: a fine grid on the angle, every local minimum refined."""
    assert problem.blocks[0][1] == 2 and len(problem.blocks) == 1
    gram, g, c = problem.root.T @ problem.root, problem.root.T @ problem.target, problem.value(0 * problem.target)
    p, n = problem.blocks[0][0], problem.linear

    def value(angle):
        lift = np.zeros((len(g), n + p))
        lift[:n, :n] = np.eye(n)
        lift[n:, n:] = np.kron(np.array([[np.cos(angle)], [np.sin(angle)]]), np.eye(p))
        small = lift.T @ g
        return c - small @ np.linalg.solve(lift.T @ gram @ lift, small)

    angles = np.pi * np.arange(points) / points
    values = np.array([value(angle) for angle in angles])
    best = np.inf
    for k in np.flatnonzero((values <= np.roll(values, 1)) & (values <= np.roll(values, -1))):
        around = angles[k] - np.pi / points, angles[k] + np.pi / points
        angle = minimize_scalar(value, bounds=around, method="bounded", options={"xatol": 1e-9}).x
        best = min(best, direction_value(problem, np.array([np.cos(angle), np.sin(angle)])))
    return best


def coloured(rng: np.random.Generator, rows: int, nb: int, correlation: float) -> np.ndarray:
    """A bounded input of some correlation from sample to sample."""
    u = rng.standard_normal(rows + 100 + nb)
    for k in range(1, len(u)):
        u[k] = correlation * u[k - 1] + np.sqrt(1 - correlation**2) * u[k]
    return np.tanh(u[100:] / 1.5)


def regress(design: np.ndarray, y: np.ndarray, blocks, linear: int) -> RankOne:
    """Compress an explicit small regression."""
    triangle = np.linalg.qr(np.column_stack([design, y]), mode="r")
    n = design.shape[1]
    return RankOne(triangle[:n, :n], triangle[:n, n], float(triangle[n, n] ** 2), tuple(blocks), linear)


def hammerstein(seed: int, nb: int, p: int, rows: int, snr: float = 3.0, correlation: float = 0.0, channels: int = 1,
                rank: int = 1, silent: tuple[int, ...] = (), linear: int = 2) -> RankOne:
    """Random FIR Hammerstein regression in Legendre polynomials, with nuisance regressors and white noise."""
    rng = np.random.default_rng(seed)
    design, y = [rng.standard_normal((rows, linear))], 0.0
    for channel in range(channels):
        values = np.polynomial.legendre.legvander(coloured(rng, rows, nb, correlation), p)[:, 1:]
        lagged = np.hstack([values[nb - j:nb - j + rows] for j in range(nb)])
        truth = sum(np.kron(rng.standard_normal(nb), rng.standard_normal(p)) for _ in range(rank))
        y = y + (0.0 if channel in silent else 1.0) * lagged @ truth
        design.append(lagged)
    y = y + design[0] @ rng.standard_normal(linear)
    noise = 0.0 if np.isinf(snr) else np.sqrt(np.var(y) / snr)
    return regress(np.hstack(design), y + noise * rng.standard_normal(rows), [(p, nb)] * channels, linear)


def monotone(seed: int, nb: int, p: int, rows: int, snr: float = 1.0,
             correlation: float = 0.5) -> tuple[RankOne, np.ndarray]:
    """Regression on triangular functions with a monotone truth that has flat pieces; (problem, increments (P, P))."""
    rng = np.random.default_rng(seed)
    u = coloured(rng, rows, nb, correlation)
    nodes = np.linspace(u.min(), u.max(), p + 1)
    values = np.delete(np.maximum(0, 1 - np.abs(u[:, None] - nodes) / (nodes[1] - nodes[0])), p // 2, axis=1)
    increments = np.delete(np.diff(np.eye(p + 1), axis=0), p // 2, axis=1)
    lagged = np.hstack([values[nb - j:nb - j + rows] for j in range(nb)])
    mu = np.linalg.solve(increments, rng.exponential(size=p) * (rng.random(p) < 0.6))
    y = lagged @ np.kron(rng.standard_normal(nb), mu)
    y = y + np.sqrt(max(np.var(y), 1e-6) / snr) * rng.standard_normal(rows)
    return regress(np.hstack([np.ones((rows, 1)), lagged]), y, [(p, nb)], 1), increments
