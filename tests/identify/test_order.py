"""Order: the distribution of T against windows formed and against Monte Carlo, criteria and lags against dense fits."""

import warnings

import numpy as np
import pytest
import scripts
from refusals import refuses
from scipy.signal import lfilter
from scipy.stats import kstest
from systems import by_hand, inputs, mimo, siso
from typer.testing import CliRunner

import optid
from optid.bases import Linear, Polynomial, Triangular, fitted_bases
from optid.cli.app import app
from optid.data.record import Data
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.identify.order import order_test, rank_test, scan_lags
from optid.identify.order.lags import residual_weights
from optid.identify.order.states import state_criteria
from optid.identify.order.study import block_rows_for, with_simulated_outputs
from optid.plants import EXAMPLE1, TWO_MODES
from optid.statistics import collect
from optid.statistics.expansion import expand
from optid.statistics.hankel import RegressionRows, hankel_statistics
from optid.statistics.sums import windows_of
from optid.structures import lifted_regression

benchmark = scripts.benchmark("order")


def record(n=800, seed=0, noise=0.3, colour=0.0):
    """Second order, one input and one output."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=n)
    v = lfilter([1], [1, -colour], rng.normal(size=n))
    return Data(u, lfilter([0, 1.0, 0.4], [1, -1.2, 0.6], u) + noise * v)


def positions(statistics, alpha, m, d):
    at = statistics.at
    z = np.r_[0, at(range(m), range(2 * alpha))]
    phi = np.r_[0, at(range(m), range(alpha, 2 * alpha))]
    return RegressionRows(z, phi, at(range(m, d), range(alpha, 2 * alpha)))


def linear(data):
    return expand(data, Linear())


def test_moments_of_t_from_formed_windows():
    data, alpha, n0 = record(500, colour=0.7), 4, 2
    found = order_test(data.records, linear(data), alpha)
    windows = windows_of(np.hstack([data.u, data.y]), 3 * alpha)
    j = len(windows)
    early = windows[:, : 2 * alpha]
    u, y = early[:, :, 0], early[:, alpha:, 1]
    one = np.ones((j, 1))
    phi = np.hstack([one, u[:, alpha:]])
    past = u[:, :alpha] - phi @ np.linalg.lstsq(phi, u[:, :alpha])[0]
    z = np.linalg.qr(past)[0] * np.sqrt(j)
    every = np.hstack([phi, u[:, :alpha]])
    e = y - every @ np.linalg.lstsq(every, y)[0]
    left, values, right = np.linalg.svd(y.T @ z / j)
    assert values == pytest.approx(found.singular_values, rel=1e-8)
    # covariances over lags, by sums over the formed windows; the last ones reach beyond and are nearly the same
    e2, z2 = e @ left[:, n0:], z @ right[n0:].T
    mean = variance = 0.0
    lags = range(-alpha, alpha + 1)
    shifted = [(e2[max(-k, 0) : j - max(k, 0)].T @ e2[max(k, 0) : j - max(-k, 0)] / (j - every.shape[1]),
                z2[max(-k, 0) : j - max(k, 0)].T @ z2[max(k, 0) : j - max(-k, 0)] / j) for k in lags]
    for re, rz in shifted:
        mean += np.trace(re) * np.trace(rz)
        variance += 2 * sum(np.sum(re * other) * np.sum(rz * another) for other, another in shifted)
    assert found.expected[n0] == pytest.approx(mean / j, rel=0.05)
    from scipy.stats import chi2

    g, h = variance / (2 * mean), 2 * mean**2 / variance
    assert found.thresholds[n0] == pytest.approx(g / j * chi2.isf(found.level, h), rel=0.05)


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_p_values_of_the_true_order_are_uniform(colour):
    p = []
    for seed in range(150):
        data = record(600, seed, colour=colour)
        p.append(order_test(data.records, linear(data), 5).p_values[2])
    assert kstest(p, "uniform").pvalue > 1e-3


def test_t_has_its_expectation():
    tests = [benchmark.one("combined", 1000, seed) for seed in range(60)]
    ratio = np.mean([test.statistics[4] for test in tests]) / np.mean([test.expected[4] for test in tests])
    assert ratio == pytest.approx(1, abs=0.05)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", benchmark.CASES)
def test_the_order_of_the_examples(case):
    for n, least in ((300, 17), (1000, 19)):
        found = [benchmark.one(case, n, seed).order for seed in range(20)]
        assert sum(order == 4 for order in found) >= (20 if case == "deterministic" else least)


def test_no_noise_is_decided_by_rounding():
    test = benchmark.one("deterministic", 500, 3)
    assert test.exact and test.order == test.ratio_order == 4 and "is rounding" in test.reason
    assert test.singular_values[4] < test.floor < 1e-6 * test.singular_values[3]


def test_no_dependence_on_the_input():
    rng = np.random.default_rng(0)
    data = Data(rng.normal(size=600), rng.normal(size=600))
    assert order_test(data.records, linear(data), 5).order == 0
    found = optid.order(data)
    assert found.nx == 1 and "may not depend on the inputs" in " ".join(str(found).split())


def test_units_do_not_matter():
    data = benchmark.TWO_MODES.record(np.random.default_rng(0).normal(size=(1000, 2)), 1, process=0.2, measurement=0.5)
    other = Data(data.u * [1e3, 1], data.y * [1, 1e4] + [0, 5.0])
    first, second = (order_test(d.records, linear(d), 6) for d in (data, other))
    assert second.order == first.order == 4
    assert second.p_values == pytest.approx(first.p_values, rel=1e-5, abs=1e-9)


def test_experiments_and_missing_samples():
    data = record(3000, 1)
    u, y = data.u.copy(), data.y.copy()
    y[np.random.default_rng(0).uniform(size=3000) < 0.02] = np.nan
    u[1500] = np.nan
    several = Data([u[:900], u[900:1700], u[1700:]], [y[:900], y[900:1700], y[1700:]])
    found = optid.order(several, block_rows=5)
    assert found.nx == 2 and found.lags is not None and np.isfinite(found.states.fit).all()


@pytest.mark.slow
def test_nonlinear_inputs_and_feedback():
    u = np.random.default_rng(0).uniform(-2, 2, (6000, 2))
    data = EXAMPLE1.record(u, 1, process=0.02, measurement=0.05)
    found = optid.order(data, basis=["polynomial:3", "bspline:8"], feedback_basis="bspline:6", block_rows=5)
    assert found.nx == 3


def test_simulated_outputs_follow_the_inputs_alone():
    data = record(3000, noise=0.5)
    signals = expand(data, Linear(), Polynomial(3).with_interval(-9, 9))
    (extended,), wider = with_simulated_outputs(data.records, signals, 8)
    clean = lfilter([0, 1.0, 0.4], [1, -1.2, 0.6], data.u[:, 0])
    assert np.isnan(extended[:15, 2]).all() and wider.simulated
    assert np.std(extended[15:, 2] - clean[15:]) < 0.1 * clean.std()


def test_the_choice_has_a_reason():
    data = record()
    statistics = hankel_statistics(data.records, 15)
    regression = positions(statistics, 5, 1, 2)
    n, reason = rank_test(statistics, regression, rows=10).choice
    assert n == 2 and "order 1 is rejected" in reason
    assert rank_test(statistics, regression, rows=10, largest=1).choice == (
        1, "1: every smaller order is rejected and the block rows show no larger one; use more block rows")


def test_refusals_of_the_test():
    data = record()
    statistics = hankel_statistics(data.records, 15)
    regression = positions(statistics, 5, 1, 2)
    refuses(StructureError, "take windows that are longer", rank_test, statistics, regression, rows=15)
    refuses(StructureError, "within the first 9 block rows", rank_test, statistics, regression, rows=9)
    refuses(StructureError, "level=2", rank_test, statistics, regression, rows=10, level=2)
    refuses(StructureError, "5 positive numbers", rank_test, statistics, regression, rows=10, scale=np.zeros(5))
    short = hankel_statistics([np.hstack([data.u, data.y])[:28]], 15)
    refuses(RankError, "14 complete windows for 11 instruments and 5 outputs", rank_test, short, regression, rows=10)


def test_prediction_errors_of_full_order_are_those_of_least_squares():
    data, alpha = record(700), 3
    signals = linear(data)
    statistics = hankel_statistics(data.records, 2 * alpha, signals, centre="mean")
    found = state_criteria(statistics, signals, alpha, 2 * alpha, statistics, statistics)
    windows = windows_of(np.hstack([data.u, data.y]), 2 * alpha)
    j = len(windows)
    phi = np.column_stack([np.ones(j), windows[:, :alpha].reshape(j, -1), windows[:, alpha:, 0]])
    y = windows[:, alpha:, 1]
    error = y - phi @ np.linalg.lstsq(phi, y)[0]
    k = 2 * alpha * 3 + 2
    likelihood = j / alpha * np.linalg.slogdet(error.T @ error / j)[1]
    assert found.aic[-1] == pytest.approx(likelihood + 2 * k, abs=1e-3)
    assert found.bic[-1] - found.aic[-1] == pytest.approx((np.log(j) - 2) * k)
    assert found.aicc[-1] - found.aic[-1] == pytest.approx(2 * k * (k + 1) / (j - k - 1))
    assert found.fit[-1] == pytest.approx(np.mean(100 * (1 - np.std(error, axis=0) / np.std(y, axis=0))), abs=1e-3)
    assert np.all(np.diff(found.aic - 2 * np.arange(2 * alpha + 1) * 3) < 1e-6)


def test_criteria_and_hold_out_find_a_white_noise_innovation_model():
    rng = np.random.default_rng(2)
    u, e = rng.normal(size=2000), 0.3 * rng.normal(size=2000)
    y = lfilter([0, 1.0, 0.4], [1, -1.2, 0.6], u) + lfilter([1, -0.5, 0.2], [1, -1.2, 0.6], e)
    found = optid.order(Data(u, y))
    assert found.nx == 2 and found.states.best()["bic"] == 2 and abs(found.states.best()["hold-out"] - 2) <= 1


def arx(n=900, seed=0, nonlinear=False):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (n, 2))
    w = np.column_stack([np.tanh(3 * u[:, 0]) if nonlinear else u[:, 0], u[:, 1]])
    right = lfilter([0, 0, 1.0, 0.5, 0.3], [1], w[:, 0]) + lfilter([0, 0.7], [1], w[:, 1]) + 0.1 * rng.normal(size=n)
    return Data(u, lfilter([1], [1, -1.2, 0.6], right))


def rows_of(data, one, reach=4):
    """Dense regressor and target of a structure."""
    u, y, count = data.u, data.y[:, 0], len(data.y)
    columns = [np.ones(count - reach)] + [y[reach - i : count - i] for i in range(1, one.na + 1)]
    columns += [u[reach - k : count - k, c] for c in range(2) for k in range(one.nk[c], one.nk[c] + one.nb[c])]
    return np.column_stack(columns), y[reach:]


def test_lags_equal_dense_least_squares():
    data = arx(200)
    scan = scan_lags(data, fitted_bases(data, Linear()), na=3, nb=3, nk=2)
    for one in scan.candidates[::7]:
        phi, y = rows_of(data, one)
        error = y - phi @ np.linalg.lstsq(phi, y)[0]
        assert one.aic == pytest.approx(len(error) * np.log(np.mean(error**2)) + 2 * phi.shape[1], rel=1e-9)
    assert scan.rows == 196


@pytest.mark.parametrize("model", [siso(Triangular(5)), mimo()])
def test_the_regression_of_several_outputs_equals_dense_least_squares(model):
    u = inputs(model, 400)
    data = Data(u, by_hand(model, u, noise=0.1 * np.random.default_rng(5).normal(size=(400, model.l))), dt=model.dt)
    statistics, places = collect(data, model.layout), lifted_regression.positions(model.layout)
    problem = lifted_regression.lifted_problem(statistics, places, weights=residual_weights(statistics))
    n = model.memory
    columns = [-data.y[n - i : -i] for i in range(1, model.na + 1)]
    for c, f in enumerate(model.nonlinearities):
        eta = f.basis.values(data.u[:, c])
        columns += [eta[n - model.nk[c] - j : len(eta) - model.nk[c] - j] for j in range(model.nb[c])]
    phi = np.column_stack([*columns, np.ones(len(data.y) - n)])
    theta = np.linalg.lstsq(phi, data.y[n:])[0]
    residual = data.y[n:] - phi @ theta
    free = np.linalg.solve(problem.root, problem.target)
    linear = [*range(model.na * model.l), -1]
    assert free[places][linear] == pytest.approx(theta[linear], abs=1e-8)
    assert problem.remainder == pytest.approx(np.sum(residual**2 / (1.0 if model.l == 1 else np.mean(residual**2, 0))))


@pytest.mark.parametrize("nonlinear", [False, True])
def test_lags_are_found_input_by_input(nonlinear):
    data = arx(4000, 1, nonlinear)
    bases = fitted_bases(data, ["polynomial:7", "linear"] if nonlinear else Linear())
    best = scan_lags(data, bases, na=4, nb=4, nk=3).best()
    assert (best.na, best.nb, best.nk) == (2, (3, 1), (2, 1))


def test_hold_out_of_lags_by_hand():
    data = arx(1200)
    train, test = data.split(0.7)
    one = scan_lags(train, fitted_bases(train, Linear()), na=2, nb=4, nk=1, test=test).best("fit")
    other, target = rows_of(test, one)
    error = target - other @ np.linalg.lstsq(*rows_of(train, one))[0]
    expected = 100 * (1 - np.sqrt(np.mean(error**2) / np.var(target)))
    assert one.fit == pytest.approx(expected, abs=1e-6)


def test_the_study_reads_like_a_page():
    data = TWO_MODES.record(np.random.default_rng(0).normal(size=(1000, 2)), 1, process=0.05, measurement=0.2)
    found = optid.order(data)
    text = str(found)
    assert max(map(len, text.splitlines())) <= 80
    assert found.nx == 4 and "Recommended: nx = 4; na = " in text and "order 3 is rejected" in " ".join(text.split())
    figure = found.plot()
    assert len(figure.axes) == 5 and "recommended: nx = 4" in figure.get_suptitle()
    kept, left = (line.get_ydata() for line in figure.axes[0].get_lines())
    values = found.ranks.singular_values
    assert len(kept) == 4 and np.append(kept, left) * values[0] == pytest.approx(values)


def test_short_records_say_what_they_cannot():
    data = record(60)
    with pytest.warns(DataWarning, match="Nothing is held out"):
        found = optid.order(data)
    assert found.block_rows < 10 and any("Nothing is held out" in note for note in found.notes)
    assert np.isnan(found.states.fit).all() and "note: Nothing is held out" in str(found)
    with warnings.catch_warnings(action="error"):
        optid.order(data, holdout=0)


@pytest.mark.parametrize("arguments, error, words", [
    ({"block_rows": 1}, StructureError, "block_rows must be an integer of at least 2; got 1"),
    ({"block_rows": 4, "nx": 4}, StructureError, "show orders up to 3, not 4: use block_rows=5"),
    ({"nx": 0}, StructureError, "nx.* must be a positive integer; got 0"),
    ({"holdout": 1.0}, StructureError, "holdout"),
    ({"level": 0.0}, StructureError, "level=0.0"),
    ({"na": -1}, StructureError, "na must be a nonnegative integer"),
    ({"nb": 0}, StructureError, "nb must be a positive integer"),
    ({"feedback_basis": ["polynomial:2"] * 2}, StructureError, "2 feedback bases for 1 outputs"),
    ({"block_rows": 150}, RankError, "complete windows"),
    ({"block_rows": 400}, RankError, "Experiment 1 has 800 samples"),
])
def test_bad_arguments(arguments, error, words):
    refuses(error, words, optid.order, record(), **arguments)


def test_bad_records():
    data = record()
    rng = np.random.default_rng(0)
    refuses(DataError, "constant|does not move", optid.order, Data(np.ones(300), rng.normal(size=300)))
    refuses((DataError, RankError), "u1|u2", lambda: optid.order(Data(np.hstack([data.u, data.u]), data.y)))
    with pytest.raises(RankError, match="Experiment 2 has 20 samples"):
        optid.order(Data([data.u, data.u[:20]], [data.y, data.y[:20]]), block_rows=10)
    sine = np.sin(0.5 * np.arange(600))
    with pytest.raises(RankError):
        optid.order(Data(sine, lfilter([1], [1, -0.5], sine) + 0.01 * rng.normal(size=600)), basis="polynomial:3")
    assert block_rows_for(data.records, linear(data), None) == 10


@pytest.mark.slow
def test_command(tmp_path):
    data = TWO_MODES.record(np.random.default_rng(0).normal(size=(600, 2)), 1, measurement=0.1)
    rows = [",".join(f"{x:.9g}" for x in row) for row in np.hstack([data.u, data.y])]
    (tmp_path / "data.csv").write_text("\n".join(["a,b,c,d", *rows]))
    words = ["order", str(tmp_path / "data.csv"), "--inputs", "a", "b", "--outputs", "c", "d", "--picture",
             str(tmp_path / "order.png")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0 and "Recommended: nx = 4" in done.output
    assert (tmp_path / "order.png").stat().st_size > 1e4
    assert CliRunner().invoke(app, [*words[:-1], str(tmp_path / "nowhere" / "order.png")]).exit_code == 2
    assert CliRunner().invoke(app, [*words[:-2], "--block-rows", "1"]).exit_code == 2
    assert CliRunner().invoke(app, ["order", "--example", "thruster", "--basis", "polynomial:3"]).exit_code == 0
