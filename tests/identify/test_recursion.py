"""Recursive identification against Algorithm 3.2 written out, and against the batch least squares."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from optid.bases import BSpline, Linear, PiecewiseConstant, Polynomial, Triangular, Trigonometric, UserFunctions
from optid.data.record import Data
from optid.errors import DataError, ModelFileError, RankError, StructureError
from optid.examples import example
from optid.identify.recursive import RecursiveARX
from optid.statistics import collect, factorise

INSIDE = (-1.0, 1.0)


def record(n=300, m=1, l=1, seed=0):  # noqa: E741
    """Inputs and outputs of stable systems with a cubic nonlinearity; one channel comes as (N,)."""
    rng = np.random.default_rng(seed)
    u, e = rng.uniform(-1, 1, (n, m)), 0.1 * rng.standard_normal((n, l))
    gains = rng.standard_normal((2, m, l))
    y = np.zeros((n, l))
    for k in range(2, n):
        f = [x + 0.5 * x**2 - x**3 for x in (u[k], u[k - 1])]
        y[k] = 0.8 * y[k - 1] - 0.3 * y[k - 2] + f[0] @ gains[0] + f[1] @ gains[1] + 0.2 + e[k]
    return (u[:, 0] if m == 1 else u), (y[:, 0] if l == 1 else y)


def rows_of(u, y, recursion):
    """Form every regressor row and its target sample by sample, straight from the model equation."""
    layout = recursion.layout
    u, y = u.reshape(len(u), -1), y.reshape(len(y), -1)
    values = [basis.values(x) for basis, x in zip(layout.bases, u.T)]
    phi = np.full((len(y), layout.n_columns), np.nan)
    for k in range(layout.first_row, len(y)):
        row = [-y[k - i] for i in range(1, layout.na + 1)]
        for eta, nb, nk in zip(values, layout.nb, layout.nk):
            row += [eta[k - nk - j] for j in range(nb)]
        phi[k] = np.concatenate([*row, [1.0]])
    return phi, y


def textbook(phi, y, theta, P, weights, forgetting=1.0):
    """Algorithm 3.2 with y(t) against phi(t); skips rows with a missing entry."""
    innovations = np.full(y.shape, np.nan)
    for t in range(len(y)):
        if np.isnan(phi[t]).any() or np.isnan(y[t]).any() or weights[t] == 0:
            continue
        P = P / forgetting
        d = 1 + weights[t] * phi[t] @ P @ phi[t]
        innovations[t] = y[t] - phi[t] @ theta
        theta = theta + weights[t] * np.outer(P @ phi[t], innovations[t]) / d
        P = P - weights[t] * np.outer(P @ phi[t], phi[t] @ P) / d
        P = (P + P.T) / 2
    return theta, P, innovations


CASES = {
    "triangular": {"na": 2, "nb": 2, "basis": Triangular(6, INSIDE)},
    "trigonometric": {"na": 1, "nb": 3, "nk": 2, "basis": Trigonometric(2, 1.25, INSIDE)},
    "spline, no past outputs": {"na": 0, "nb": 2, "basis": BSpline(3, 3, INSIDE)},
    "steps": {"na": 3, "nb": 1, "nk": 1, "basis": PiecewiseConstant(4, INSIDE)},
    "static": {"na": 0, "nb": 1, "basis": Polynomial(3, INSIDE)},
    "two inputs, two outputs": {
        "na": 2, "nb": (2, 1), "nk": (0, 1), "basis": [Triangular(4, INSIDE), Polynomial(3, INSIDE)],
        "inputs": ["u1", "u2"], "outputs": ["y1", "y2"],
    },
    "linear": {"na": 2, "nb": 2, "basis": Linear()},
}


def started(case, **more):
    settings = {**CASES[case], **more}
    return RecursiveARX(**settings), record(m=len(settings.get("inputs", "u")), l=len(settings.get("outputs", "y")))


@pytest.mark.sampled(6)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("forgetting", [1.0, 0.98])
def test_equals_algorithm_3_2_written_out(case, forgetting):
    rng = np.random.default_rng(7)
    recursion, (u, y) = started(case, P0=1e3, theta0=0.3, forgetting=forgetting)
    weights = rng.uniform(0, 2, len(u)) * (rng.random(len(u)) > 0.1)
    phi, target = rows_of(u, y, recursion)
    n, l = phi.shape[1], target.shape[1]  # noqa: E741
    theta, P, expected = textbook(phi, target, np.full((n, l), 0.3), 1e3 * np.eye(n), weights, forgetting)
    innovations = recursion.update(u, y, weights)
    np.testing.assert_allclose(recursion.theta, theta, rtol=0, atol=1e-9 * np.abs(theta).max())
    np.testing.assert_allclose(recursion.P, P, rtol=0, atol=1e-8 * np.abs(P).max())
    np.testing.assert_allclose(innovations, expected, rtol=0, atol=1e-9)
    assert recursion.rows == np.count_nonzero(np.isfinite(expected[:, 0])) and recursion.samples == len(u)


@pytest.mark.parametrize("shape", ["number", "large", "diagonal", "matrix"])
def test_prior_is_the_regularisation_it_says(shape):
    recursion, (u, y) = started("triangular")
    n = recursion.layout.n_columns
    rng = np.random.default_rng(3)
    theta0, factor = rng.standard_normal(n), rng.standard_normal((n, n))
    covariance = {"number": 7.0, "large": 1e12, "diagonal": rng.uniform(0.1, 5, n),
                  "matrix": factor @ factor.T + np.eye(n)}[shape]
    full = np.atleast_1d(covariance)
    inverse = np.linalg.inv(full if full.ndim == 2 else np.diag(np.broadcast_to(full, n)))
    recursion = RecursiveARX(**CASES["triangular"], theta0=theta0, P0=covariance)
    np.testing.assert_allclose(recursion.theta[:, 0], theta0, atol=1e-9)
    recursion.update(u, y)
    phi, target = (part[recursion.layout.first_row :] for part in rows_of(u, y, recursion))
    batch = np.linalg.solve(phi.T @ phi + inverse, phi.T @ target[:, 0] + inverse @ theta0)
    np.testing.assert_allclose(recursion.theta[:, 0], batch, atol=1e-10)


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_the_batch_fit_when_nothing_is_forgotten(case):
    recursion, (u, y) = started(case)
    recursion.update(u, y)
    layout = recursion.layout
    batch = factorise(Data(u, y, inputs=layout.inputs, outputs=layout.outputs), layout)
    n = layout.n_columns
    expected = np.linalg.solve(batch.root[:n, :n], batch.root[:n, n:])
    np.testing.assert_allclose(recursion.theta, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    np.testing.assert_allclose(recursion.statistics.root, batch.root, rtol=0, atol=1e-11 * np.abs(batch.root).max())
    assert (recursion.rows, recursion.candidates) == (batch.rows, batch.candidates)


def test_a_second_record_continues_the_first():
    first, second = record(seed=1), record(seed=2)
    data = Data([first[0], second[0]], [first[1], second[1]])
    recursion = RecursiveARX(**CASES["triangular"])
    innovations = recursion.read(data)
    batch = factorise(data, recursion.layout)
    np.testing.assert_allclose(recursion.statistics.gram, batch.gram, atol=1e-9)
    assert [len(e) for e in innovations] == [300, 300] and np.isnan(innovations[1][:2]).all()
    carried_on = RecursiveARX(**CASES["triangular"])
    for u, y in (first, second):
        carried_on.update(u, y)
    assert carried_on.rows == recursion.rows + recursion.layout.first_row


@given(st.lists(st.integers(0, 200), max_size=5), st.integers(0, 1000), st.sampled_from([1.0, 0.97]))
def test_blocks_do_not_matter(cuts, seed, forgetting):
    u, y = record(200, seed=seed)
    whole, parts = (RecursiveARX(**CASES["triangular"], forgetting=forgetting) for _ in range(2))
    expected = whole.update(u, y)
    edges = [0, *sorted(cuts), 200]
    found = np.vstack([parts.update(u[i:j], y[i:j]) for i, j in zip(edges, edges[1:])])
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(parts.root, whole.root)
    assert (parts.samples, parts.rows, parts.candidates) == (whole.samples, whole.rows, whole.candidates)


def test_one_sample_at_a_time():
    recursion, (u, y) = started("two inputs, two outputs")
    one_by_one, _ = started("two inputs, two outputs")
    found = np.vstack([one_by_one.update(u[k], y[k]) for k in range(60)])
    np.testing.assert_allclose(found, recursion.update(u[:60], y[:60]), atol=1e-12)
    np.testing.assert_allclose(one_by_one.root, recursion.root, atol=1e-12)


@given(seed=st.integers(0, 10_000))
def test_missing_samples_cost_the_rows_that_touch_them(seed):
    rng = np.random.default_rng(seed)
    recursion, (u, y) = started("two inputs, two outputs")
    u, y = np.where(rng.random(u.shape) < 0.03, np.nan, u), np.where(rng.random(y.shape) < 0.03, np.nan, y)
    innovations = recursion.update(u, y)
    phi, target = rows_of(u, y, recursion)
    used = np.isfinite(phi).all(axis=1) & np.isfinite(target).all(axis=1)
    expected = np.linalg.lstsq(phi[used], target[used])[0]
    np.testing.assert_allclose(recursion.theta, expected, atol=1e-9 * np.abs(expected).max())
    assert recursion.rows == used.sum() and recursion.candidates == len(u) - recursion.layout.first_row
    assert np.isnan(innovations[~used]).all() and np.isfinite(innovations[used]).sum() > 200


def test_says_what_is_not_determined_yet():
    recursion, (u, y) = started("triangular")
    n, reach = recursion.layout.n_columns, recursion.layout.first_row
    trace = recursion.trace(u[: n + reach - 1], y[: n + reach - 1])
    assert np.isnan(trace.theta).all() and np.isnan(trace.innovations[: n + reach - 1]).all()
    refuses(RankError, "14 rows so far", lambda: recursion.theta)
    trace = recursion.trace(u[n + reach - 1 :], y[n + reach - 1 :])
    assert np.isfinite(trace.theta[-200:]).all() and np.isfinite(trace.innovations[-200:]).all()
    half = RecursiveARX(na=1, nb=1, basis=Triangular(6, INSIDE))
    half.update(np.abs(u), y)  # no sample reaches the left nodes
    refuses(RankError, "triangular1", lambda: half.theta)


@pytest.mark.parametrize("split", ["whitened", "plain"])
@pytest.mark.parametrize("case", ["triangular", "two inputs, two outputs"])
def test_a_noise_free_system_is_recovered(split, case):
    recursion, (u, _) = started(case)
    layout, rng = recursion.layout, np.random.default_rng(5)
    mus = [rng.standard_normal(basis.size) for basis in layout.bases]
    bs = [rng.standard_normal((nb, layout.l)) for nb in layout.nb]
    a = np.array([[-0.9, 0.1], [0.05, -0.4]])[: layout.l, : layout.l], 0.2 * np.eye(layout.l)
    y = np.zeros((len(u), layout.l))
    f = [basis.values(x) @ mu for basis, x, mu in zip(layout.bases, u.reshape(len(u), -1).T, mus)]
    for k in range(layout.first_row, len(u)):
        y[k] = 0.7 - a[0] @ y[k - 1] - a[1] @ y[k - 2]
        y[k] += sum(g[k - nk - j] * b[j] for g, b, nk in zip(f, bs, layout.nk) for j in range(len(b)))
    recursion.update(u, y)
    model = recursion.model(split)
    for c, (mu, b) in enumerate(zip(mus, bs)):
        np.testing.assert_allclose(model.theta(c), np.outer(mu, b.ravel(order="F")), atol=1e-9)
        values = np.linalg.svd(recursion.matrices[c], compute_uv=False)
        assert values[1] < 1e-9 * values[0]
    np.testing.assert_allclose(model.a, a if layout.l > 1 else np.ravel(a), atol=1e-9)
    np.testing.assert_allclose(model.offset, 0.7, atol=1e-9)
    assert np.linalg.norm(model.b[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("split", ["whitened", "plain"])
@pytest.mark.parametrize("case", ["triangular", "trigonometric", "two inputs, two outputs"])
def test_the_model_is_that_of_algorithm_3_1_on_the_whole_record(split, case):
    from optid.identify.fitting import fit

    recursion, (u, y) = started(case)
    layout = recursion.layout
    recursion.update(u, y)
    data = Data(u, y, inputs=layout.inputs, outputs=layout.outputs)
    batch = fit(data, "hammerstein_arx.overparametrised", na=layout.na, nb=layout.nb, nk=layout.nk, basis=layout.bases,
                svd=split, accuracy=1e-10, prove=False).model
    model = recursion.model(split)
    np.testing.assert_allclose(model.a, batch.a, atol=1e-9)
    for c in range(layout.m):
        np.testing.assert_allclose(model.b[c], batch.b[c], atol=1e-9)
        np.testing.assert_allclose(model.theta(c), batch.theta(c), atol=1e-9)
    np.testing.assert_allclose(model.predict(data), batch.predict(data), atol=1e-9)


def test_the_whitened_split_is_the_nearest_pair_in_its_metric():
    """Where the Gram matrix is exactly a Kronecker product, the whitened SVD is the least-squares optimum."""
    from optid.structures.lifted_regression import leading_pairs
    from optid.structures.rank_one import RankOne

    rng = np.random.default_rng(0)
    theta, left, right = (rng.standard_normal(shape) for shape in ((5, 3), (5, 5), (3, 3)))
    gram = np.kron(right @ right.T, left @ left.T)

    def loss(mu, b):
        rest = (theta - np.outer(mu, b)).ravel(order="F")
        return rest @ gram @ rest

    core = RankOne(np.linalg.cholesky(gram).T, np.zeros(15), 0.0, ((5, 3),)).core
    best = np.inf
    for _ in range(20):  # alternating least squares from random starts
        b = rng.standard_normal(3)
        for _ in range(300):
            lift = np.kron(b[:, None], np.eye(5))
            mu = np.linalg.solve(lift.T @ gram @ lift, lift.T @ gram @ theta.ravel(order="F"))
            lift = np.kron(np.eye(3), mu[:, None])
            b = np.linalg.solve(lift.T @ gram @ lift, lift.T @ gram @ theta.ravel(order="F"))
        best = min(best, loss(mu, b))
    assert loss(*leading_pairs(core, [theta])[0]) == pytest.approx(best, rel=1e-8)
    assert loss(*leading_pairs(core, [theta], whitened=False)[0]) > 1.01 * best


def test_trace_holds_the_estimates_of_the_shorter_records():
    u, y = record()
    recursion = RecursiveARX(**CASES["triangular"], P0=1e3)
    recursion.update(u[:10], y[:10])
    trace = recursion.trace(u[10:], y[10:], every=40)
    np.testing.assert_array_equal(trace.samples, [40, 80, 120, 160, 200, 240, 280])
    mu, b, ratio = trace.split(beta=0.75)
    for k, count in enumerate(trace.samples):
        shorter = RecursiveARX(**CASES["triangular"], P0=1e3)
        shorter.update(u[:count], y[:count])
        np.testing.assert_allclose(trace.theta[k], shorter.theta, atol=1e-12)
        np.testing.assert_allclose(trace.a[k], shorter.theta[:2, 0], atol=1e-12)
        np.testing.assert_allclose(np.outer(mu[k], b[k]), shorter.model("plain").theta(), atol=1e-10)
        values = np.linalg.svd(shorter.matrices[0], compute_uv=False)
        assert np.linalg.norm(b[k]) == pytest.approx(1 / 0.75) and ratio[k] == pytest.approx(values[1] / values[0])


def test_a_million_samples_do_not_drift():
    rng = np.random.default_rng(0)
    n = 1_000_000
    u, e = rng.uniform(-1, 1, n), 0.1 * rng.standard_normal(n)
    from scipy.signal import lfilter

    y = lfilter([1.0, 0.75], [1.0, -1.5, 0.7], np.maximum(u, 0.0)) + lfilter([1.0], [1.0, -1.5, 0.7], e)
    settings = {"na": 2, "nb": 2, "basis": Triangular(4, INSIDE)}
    forever, fading = RecursiveARX(**settings), RecursiveARX(**settings, forgetting=0.999)
    innovations = forever.update(u, y)
    fading.update(u, y)
    data, k = Data(u, y), forever.layout.n_columns
    batch = collect(data, forever.layout).root
    np.testing.assert_allclose(forever.theta, np.linalg.solve(batch[:k, :k], batch[:k, k:]), rtol=0, atol=1e-11)
    np.testing.assert_allclose(forever.root, batch, rtol=0, atol=1e-10 * np.abs(batch).max())
    # 0.999^60000 is 1e-26: earlier samples do not count
    late = Data(u[-60000:], y[-60000:])
    weights = 0.999 ** np.arange(len(late.u) - 1, -1, -1)
    batch = factorise(late, fading.layout, [weights]).root
    np.testing.assert_allclose(fading.theta, np.linalg.solve(batch[:k, :k], batch[:k, k:]), rtol=0, atol=1e-11)
    np.testing.assert_allclose(fading.root, batch, rtol=0, atol=1e-11 * np.abs(batch).max())
    assert np.linalg.eigvalsh(fading.P).min() > 0
    assert np.nanstd(innovations[1000:]) == pytest.approx(0.1, rel=0.01)  # the innovations are e


def test_a_direction_without_excitation_keeps_its_estimate():
    """0.9^(n/2) of 200,000 samples is far below the smallest double; a covariance would have overflowed."""
    rng = np.random.default_rng(1)
    n = 200_000
    settings = {"na": 1, "nb": 1, "basis": Triangular(4, INSIDE), "forgetting": 0.9}
    u = np.concatenate([rng.uniform(-1, 1, 500), rng.uniform(0, 1, n), rng.uniform(-1, 1, 500)])
    y = np.zeros_like(u)
    for k in range(1, len(u)):
        y[k] = 0.5 * y[k - 1] + np.abs(u[k])  # f(-1) - f(0) = 1 is the coefficient of the first hat
    recursion = RecursiveARX(**settings)
    recursion.update(u[:500], y[:500])
    assert recursion.theta[1, 0] == pytest.approx(1.0, abs=1e-9)
    recursion.update(u[500:-500], y[500:-500])
    assert np.isfinite(recursion.root).all() and not ((recursion.root != 0) & (np.abs(recursion.root) < 1e-200)).any()
    assert recursion.theta[1, 0] == pytest.approx(1.0, abs=1e-6)
    recursion.update(u[-500:], y[-500:])
    assert recursion.theta[1, 0] == pytest.approx(1.0, abs=1e-9)


@given(seed=st.integers(0, 1000), at=st.integers(0, 150))
def test_a_restored_state_continues_bit_for_bit(tmp_path_factory, seed, at):
    path = tmp_path_factory.mktemp("state") / "state.npz"
    u, y = record(150, m=2, l=2, seed=seed)
    u[seed % 150, 0] = np.nan
    recursion, _ = started("two inputs, two outputs", forgetting=0.995, P0=10.0, dt=0.1, input_units=["A", "V"])
    recursion.update(u[:at], y[:at])
    assert recursion.save(path) == path
    restored = RecursiveARX.load(path)
    np.testing.assert_array_equal(restored.update(u[at:], y[at:]), recursion.update(u[at:], y[at:]))
    for name in ("root", "past_u", "past_y"):
        assert getattr(restored, name).tobytes() == getattr(recursion, name).tobytes()
    for name in ("layout", "forgetting", "dt", "samples", "rows", "candidates", "input_units", "output_units"):
        assert getattr(restored, name) == getattr(recursion, name)


def test_user_functions_are_asked_for_again(tmp_path):
    cube, settings = lambda x: x**3, {"na": 1, "nb": 1}
    recursion = RecursiveARX(basis=UserFunctions((cube,), ("cube",), interval=INSIDE), **settings)
    path = recursion.save(tmp_path / "state")
    refuses(StructureError, "cube", RecursiveARX.load, path)
    assert RecursiveARX.load(path, {"cube": cube}).layout.bases[0].size == 1


def test_files_that_are_not_states(tmp_path):
    recursion, (u, y) = started("triangular")
    path = recursion.save(tmp_path / "state.npz")
    content = path.read_bytes()
    for name, broken in {"cut": content[: len(content) // 2], "empty": b"", "text": b"{}"}.items():
        bad = tmp_path / name
        bad.write_bytes(broken)
        refuses(ModelFileError, name, RecursiveARX.load, bad)
    with np.load(path) as file:
        parts = dict(file)
    for change, message in (
        ({"head": np.array(str(parts["head"]).replace('"version": 1', '"version": 99'))}, "version 99"),
        ({"head": np.array('{"a": 1}')}, "not the state"),
        ({"head": np.array(str(parts["head"]).replace('"settings"', '"other"'))}, "settings"),
        ({"root": np.eye(3)}, "root"),
    ):
        np.savez(path, **{**parts, **change})
        refuses(ModelFileError, message, RecursiveARX.load, path)
    with pytest.raises(FileNotFoundError):
        RecursiveARX.load(tmp_path / "none.npz")


def test_bad_settings():
    good = CASES["triangular"]
    for change, message in (
        ({"forgetting": 0.0}, "forgetting"), ({"forgetting": 1.01}, "forgetting"), ({"P0": 0.0}, "P0"),
        ({"P0": -np.eye(15)}, "P0"), ({"P0": np.ones(3)}, "P0 has shape"), ({"theta0": np.ones(3)}, "theta0"),
        ({"basis": Triangular(6)}, "interval"), ({"nb": (2, 2)}, "nb"), ({"na": -1}, "na"),
    ):
        refuses(StructureError, message, RecursiveARX, **{**good, **change})
    refuses(DataError, "dt", RecursiveARX, **good, dt=0.0)
    refuses(DataError, "two channels", RecursiveARX, **good, outputs="u")
    recursion, (u, y) = started("triangular")
    refuses(StructureError, "every", recursion.trace, u, y, every=0)
    with pytest.raises(StructureError, match="split"):
        recursion.model("best")  # pyright: ignore[reportArgumentType]
    refuses(DataError, "raw", RecursiveARX.like, Data(u, y).detrend(), na=1, nb=1, basis="triangular:3")
    refuses(DataError, "raw", recursion.read, Data(u, y).scale())
    refuses(DataError, "valve -> y, the model u -> y", recursion.read, Data(u, y, inputs="valve"))


def test_bad_samples_leave_the_state_alone():
    recursion = RecursiveARX(na=1, nb=1, basis=Triangular(4, INSIDE, outside="error"))
    u, y = record(50)
    recursion.update(u, y)
    before = recursion.root.copy(), recursion.past_u.copy(), recursion.samples
    infinite, outside = y.copy(), u.copy()
    infinite[7], outside[9] = np.inf, 1.5
    for bad_u, bad_y, weights, message in (
        (u, infinite, 1.0, "'y': sample 57"), (outside, y, 1.0, "'u', sample 59"), (u[:-1], y, 1.0, "49 samples"),
        (u[None], y, 1.0, "shape"), (u, y[:, None, None], 1.0, "shape"), (u, y, -1.0, "weights"),
        (u, y, np.ones(3), "weights"),
    ):
        refuses(DataError, message, recursion.update, bad_u, bad_y, weights)
    np.testing.assert_array_equal(recursion.root, before[0])
    np.testing.assert_array_equal(recursion.past_u, before[1])
    assert recursion.samples == before[2]


def test_the_callers_arrays_are_not_changed():
    recursion, (u, y) = started("triangular")
    copies = u.copy(), y.copy()
    recursion.update(u, y)
    np.testing.assert_array_equal((u, y), copies)


def test_like_takes_channels_and_ranges_from_a_record():
    data = example("two_inputs").data
    recursion = RecursiveARX.like(data, na=2, nb=2, basis="triangular:8")
    assert recursion.layout.inputs == data.inputs and recursion.input_units == data.input_units
    assert recursion.layout.bases[1].interval == (data.u[:, 1].min(), data.u[:, 1].max())
    recursion.read(data)
    assert recursion.model().inputs == data.inputs and "2 rows" not in repr(recursion)
    np.testing.assert_allclose(recursion.model().a, [-1.1, 0.3], atol=0.05)


def test_a_large_prior_covariance_tends_to_the_batch_fit():
    (u, y), theta = record(), {}
    for P0 in (1e4, 1e8, 1e12, np.inf):
        recursion = RecursiveARX(**CASES["triangular"], P0=P0)
        recursion.update(u, y)
        theta[P0] = recursion.theta
    gaps = [np.abs(theta[P0] - theta[np.inf]).max() for P0 in (1e4, 1e8, 1e12)]
    assert gaps[0] > 1e-7 and gaps[1] < 1e-3 * gaps[0] and gaps[2] < 1e-9
