"""Several faults at once: the group-sparse programme, its proof and its solvers, the exact search near its onsets."""

from dataclasses import replace
from itertools import combinations

import cvxpy as cp
import numpy as np
import pytest
from fault_plants import LOAD, levels, record, refused
from test_fault_injection import small

from optid.backends import Answer, BackEnd, find
from optid.core.group_sparse import GroupSparseForm
from optid.core.statement import for_solvers, statement_of
from optid.errors import LookupFailed, StructureError
from optid.faults import (
    Fault,
    best_subsets,
    dictionary,
    model_uncertainty,
    scan,
    signature_estimate,
    thresholds,
    whiten,
)
from optid.faults.search.sparse import atoms_of
from optid.program.solution import Status
from optid.registry import fault_formulation
from optid.solving.solve import solve

N = 40


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD})


@pytest.fixture(scope="module")
def limits(found):
    return thresholds(found, N, draws=5000)


def window(found, seed, faults=(), missing=0.0):
    return whiten(found.model, record(found.model, seed, faults, missing, N), x0="zero")


def two(found, seed=1, **how):
    faults = [Fault.step("sensor:y1", 10, 0.9), Fault.step("actuator:u2", 25, 1.5)]
    return scan(found, window(found, seed, faults, **how))


# -- atoms ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("missing", [0.0, 0.2, "uncertain"])
def test_atoms_explain_what_the_scan_says(found, limits, missing):
    if missing == "uncertain":  # and losses
        u, model = levels(N, 4), found.model
        found = dictionary(model, kinds=["bias", "loss"])
        data = record(model, 4, Fault.loss("actuator:u1", 15, 0.5), 0.0, N)
        uncertain = model_uncertainty(model, record(model, 9, count=400))
        s = scan(found, whiten(model, data, uncertainty=uncertain), u)
        limits = thresholds(found, N, u=u, draws=5000)
    else:
        s = two(found, missing=missing)
    for atom in atoms_of(s, limits):
        row = s.statistic[s.index(atom.label)][atom.onsets]
        energy = np.sum(np.einsum("tkd,k->td", atom.axes, s.whitened.r.ravel()) ** 2, axis=1)
        np.testing.assert_allclose(energy, row, rtol=1e-5, atol=1e-8)


# -- the programme -------------------------------------------------------------------------------------------------


@pytest.mark.sampled(3)
@pytest.mark.parametrize("seed", range(6))
def test_something_is_active_exactly_when_the_search_alarms(found, limits, seed):
    size = 0.1 * seed
    s = scan(found, window(found, seed, [Fault.step("sensor:y2", 15, size)] if seed else []))
    result = signature_estimate(s, limits)
    q = limits.of(found.labels)[:, None]
    assert result.certified and result.alarm == bool(np.nanmax(s.gains(limits)) > 0)
    assert result.largest == pytest.approx(np.sqrt(np.nanmax(s.statistic / q)), rel=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_own_solver_and_conic_solvers_agree(found, limits, missing):
    s = two(found, missing=missing)
    own = signature_estimate(s, limits)
    assert own.solver == "block_descent" and own.certified and own.gap <= 1e-9 and own.alarm
    for solver in ("clarabel", "qoco"):
        other = signature_estimate(s, limits, solver=solver)
        assert other.certified and other.gap <= 1e-6
        assert other.objective == pytest.approx(own.objective, rel=1e-6)


@pytest.mark.parametrize("penalty", [0.3, 1.0, 3.0])
def test_optimality_conditions_group_by_group(found, limits, penalty):
    s = two(found)
    atoms, r = atoms_of(s, limits), s.whitened.r.ravel()
    result = signature_estimate(s, limits, penalty=penalty, settings={"accuracy": 1e-10})
    fitted = sum((s.signature(label, onset) @ size for (label, onset), size in result.magnitudes.items()),
                 np.zeros_like(s.whitened.r))
    u = r - fitted.ravel()
    for atom in atoms:
        slopes = np.einsum("tkd,k->td", atom.axes, u)
        level = penalty * np.sqrt(atom.threshold)
        assert np.all(np.linalg.norm(slopes, axis=1) <= level * (1 + 1e-5))
        for t, onset in enumerate(atom.onsets):
            if (atom.label, int(onset)) in result.magnitudes:
                assert np.linalg.norm(slopes[t]) == pytest.approx(level, rel=1e-4)


def test_groups_ruled_out_are_zero_for_every_solver(found, limits):
    s = two(found)
    own = signature_estimate(s, limits)
    tested = sum(int(np.sum(~np.isnan(row))) for row in s.statistic)
    assert 0.5 * tested < sum(int(mask.sum()) for mask in own.provably_zero.values()) < tested
    program = next(fault_formulation("fault.signature")(s, limits))
    values = solve(program, "clarabel", accuracy=1e-10).values
    for atom in atoms_of(s, limits):
        sizes = np.linalg.norm(values[f"a[{atom.label}]"], axis=1)
        assert np.all(sizes[own.provably_zero[atom.label][atom.onsets]] < 1e-4)
    for group in own.active:
        assert not own.provably_zero[group.label][group.onset]


def test_constraint_names_bind_and_keep_a_proof(found, limits):
    s = two(found)
    free = signature_estimate(s, limits)
    first = next(group for group in free.active if group.size.size == 1)
    sign = np.sign(first.size[0])
    held = signature_estimate(s, limits, constraints=[lambda v: {"falls": sign * v[f"size[{first.label}]"] <= 0}])
    assert held.certified and held.objective > free.objective * (1 + 1e-4) and held.constrained == ("falls",)
    assert all(sign * size[0] <= 1e-6 for (label, _), size in held.magnitudes.items() if label == first.label)
    assert held.bound <= held.objective and held.gap < 1e-6
    assert not any(mask.any() for mask in held.provably_zero.values())
    loose = signature_estimate(s, limits, constraints=[lambda v: {"rises": v["size[sensor:y1]"] >= -9}])
    assert loose.objective == pytest.approx(free.objective, rel=1e-6)
    with pytest.raises(StructureError, match="takes no further constraints"):
        signature_estimate(s, limits, solver="block_descent", constraints=[lambda v: v["size[sensor:y1]"] <= 0])


def test_sizes_are_in_the_units_of_the_fault(found, limits):
    s = two(found)
    program = for_solvers(next(fault_formulation("fault.signature")(s, limits)))
    atoms = {atom.label: atom for atom in atoms_of(s, limits)}
    rng = np.random.default_rng(0)
    for name, variable in statement_of(program).variables.items():
        if name.startswith("a["):
            variable.value = rng.normal(size=variable.shape)
    for label in ("sensor:y1", "state"):
        a, size = statement_of(program).view[f"a[{label}]"].value, statement_of(program).view[f"size[{label}]"].value
        t = 7
        onset = int(atoms[label].onsets[t])
        left = (s.signature(label, onset) @ size[t]).ravel()
        np.testing.assert_allclose(left, atoms[label].axes[t] @ a[t], atol=1e-9)


# -- solvers that lie or fail --------------------------------------------------------------------------------------


def liar(shift):
    """A back end that claims success at a point beside the optimum."""
    def run(program, settings):
        answer = find("block_descent").run(program, settings)
        moved = {name: value + shift for name, value in answer.values.items()}
        return Answer(Status.OPTIMAL, "optimal", moved, answer.duals)

    return BackEnd("liar", frozenset(), run, form="group-sparse", takes=GroupSparseForm.of)


def test_a_solver_that_lies_is_not_believed(found, limits):
    s = two(found)
    result = signature_estimate(s, limits, solver=liar(0.05))
    assert not result.certified and "not stationary" in result.status
    assert not any(mask.any() for mask in result.provably_zero.values())


def test_lying_multipliers_give_no_false_bound(found, limits):
    s = two(found)
    truth = signature_estimate(s, limits).objective

    def run(program, settings):
        answer = find("block_descent").run(program, settings)
        for wild in (1e6, -3.0, np.nan):
            answer = replace(answer, duals={"residual": wild * answer.duals["residual"]})
        return answer

    wild = BackEnd("wild", frozenset(), run, form="group-sparse", takes=GroupSparseForm.of)
    result = signature_estimate(s, limits, solver=wild)
    assert result.certified and result.bound <= truth * (1 + 1e-9)


def test_wild_multipliers_of_a_user_constraint_give_no_false_bound(found, limits):
    s = two(found)
    first = next(group for group in signature_estimate(s, limits).active if group.size.size == 1)
    rule = [lambda v: {"size": first.size[0] * v[f"size[{first.label}]"] <= 0.01,
                       "sum": cp.sum(v[f"size[{first.label}]"]) == 0.02}]
    truth = signature_estimate(s, limits, constraints=rule)
    assert truth.certified
    rng = np.random.default_rng(0)
    for scale in (1e-3, 1.0, 1e3):
        def run(program, settings, scale=scale):
            answer = find("clarabel").run(program, settings)
            wild = {name: scale * rng.standard_normal(d.shape) for name, d in answer.duals.items()}
            return replace(answer, duals=wild)

        result = signature_estimate(s, limits, constraints=rule, solver=BackEnd("wild", frozenset({"SOCP"}), run))
        assert result.bound <= truth.objective * (1 + 1e-7) and not result.certified

    def short(program, settings):
        return replace(find("clarabel").run(program, settings), duals={"size": np.ones(2), "residual": np.ones(1)})

    result = signature_estimate(s, limits, constraints=rule, solver=BackEnd("short", frozenset({"SOCP"}), short))
    assert result.bound <= truth.objective * (1 + 1e-7)


@pytest.mark.parametrize("answer", [
    Answer(Status.FAILED, "out of memory"), Answer(Status.OPTIMAL, "optimal"), Answer(Status.INFEASIBLE, "infeasible"),
    Answer(Status.OPTIMAL, "optimal", {"residual": np.zeros(2 * N)})])
def test_a_solver_without_a_point_gives_no_certificate(found, limits, answer):
    s = two(found)
    mute = BackEnd("none", frozenset(), lambda *_: answer, form="group-sparse", takes=GroupSparseForm.of)
    result = signature_estimate(s, limits, solver=mute)
    assert not result.certified and not result.active and result.status and np.isinf(result.gap)
    assert best_subsets(s, limits, near=result.near()).best is None
    assert "not certified" in str(result) and max(map(len, str(result).splitlines())) <= 80


# -- the exact search near the onsets ------------------------------------------------------------------------------


def dense_gain(s, limits, members):
    r = s.whitened.r.ravel()
    G = np.concatenate([s.signature(label, onset).reshape(r.size, -1) for label, onset in members], axis=1)
    fitted = G @ np.linalg.lstsq(G, r, rcond=1e-9)[0]
    return fitted @ fitted - sum(limits.q[s.labels.index(label)] for label, _ in members)


@pytest.mark.slow
@pytest.mark.parametrize("size, missing", [(1, 0.0), (2, 0.2), (3, 0.0)])
def test_equal_to_brute_force_over_all_subsets(found, limits, size, missing):
    faults = [Fault.step("sensor:y1", 12, 0.5), Fault.jump("state", 20, [0.8, -0.8, 0.4]),
              Fault.step("actuator:u1", 28, 0.8)]
    s = scan(found, window(found, 2, faults, missing), onsets=[11, 12, 20, 28])
    search = best_subsets(s, limits, max_faults=size)
    atoms = [(label, k) for label in found.labels for k in (11, 12, 20, 28)
             if not np.isnan(s.statistic[s.labels.index(label), k])]
    values = {members: dense_gain(s, limits, members) for k in range(1, size + 1) for members in combinations(atoms, k)}
    best = max(values, key=lambda members: values[members])
    assert search.gain == pytest.approx(values[best], rel=1e-7)
    assert set(zip(search.best.labels, search.best.onsets)) == set(best)
    by_labels = {}
    for members, value in values.items():
        key = tuple(sorted(label for label, _ in members))
        by_labels[key] = max(by_labels.get(key, -np.inf), value)
    for subset in search.ranked:
        assert subset.gain == pytest.approx(by_labels[tuple(sorted(subset.labels))], rel=1e-6, abs=1e-6)
    others = [v for key, v in by_labels.items() if key != tuple(sorted(search.best.labels))]
    assert search.runner_up.gain == pytest.approx(max(others), rel=1e-6) and search.margin >= 0


def test_magnitudes_are_least_squares_and_two_faults_are_found(found, limits):
    s = two(found)
    search = best_subsets(s, limits, near=signature_estimate(s, limits).near())
    assert search.best.labels == ("actuator:u2", "sensor:y1")
    assert np.all(np.abs(np.array(search.best.onsets) - [25, 10]) <= 2)
    nu, covariance = search.estimate(search.best)
    assert np.all(np.abs(nu - [1.5, 0.9]) < 5 * np.sqrt(np.diag(covariance)))
    members = zip(search.best.labels, search.best.onsets)
    flat = np.concatenate([s.signature(a, k).reshape(2 * N, -1) for a, k in members], axis=1)
    np.testing.assert_allclose(nu, np.linalg.lstsq(flat, s.whitened.r.ravel(), rcond=None)[0], rtol=1e-6)
    assert search.searched.sum() < N
    for text in (str(search), str(search.best), str(signature_estimate(s, limits))):
        assert max(map(len, text.splitlines())) <= 80


def test_exchanges_never_lose_and_end_where_no_single_one_gains(found, limits):
    for seed in range(3):
        s = two(found, seed)
        near = signature_estimate(s, limits).near(1)
        plain = best_subsets(scan(found, s.whitened, onsets=np.flatnonzero(near)), limits)
        better, everywhere = best_subsets(s, limits, near=near), best_subsets(s, limits)
        assert plain.gain - 1e-9 <= better.gain <= everywhere.gain + 1e-7
        members = list(zip(better.best.labels, better.best.onsets))
        assert better.gain == pytest.approx(dense_gain(s, limits, members), rel=1e-7)
        for i in range(len(members)):
            for label in found.labels:
                for k in range(0, N, 3):
                    if not np.isnan(s.statistic[s.labels.index(label), k]):
                        trial = [*members[:i], (label, k), *members[i + 1 :]]
                        assert dense_gain(s, limits, trial) <= better.gain + 1e-6 or len(set(trial)) < len(trial)


# -- bad input -----------------------------------------------------------------------------------------------------


def test_bad_input(found, limits):
    s = two(found)
    wide = replace(s, statistic=np.zeros((len(found.labels), 100_000)))
    backwards, none = replace(limits, labels=limits.labels[::-1]), replace(limits, q=np.full(len(limits.q), np.nan))
    refused(
        *((StructureError, "penalty=", lambda p=p: signature_estimate(s, limits, penalty=p)) for p in (0, -1, np.nan)),
        *((StructureError, "max_faults must be", lambda k=k: best_subsets(s, limits, max_faults=k))
          for k in (0, 1.5, -1)),
        (StructureError, "other candidates", lambda: signature_estimate(s, backwards)),
        (StructureError, "no threshold", lambda: signature_estimate(s, none)),
        (StructureError, "shorter window", lambda: atoms_of(wide, limits)),
        (StructureError, "too many for an exact search", lambda: best_subsets(s, limits, max_faults=6)),
        (LookupFailed, "fault.signature", lambda: fault_formulation("fault.signatur")),
        (StructureError, "not convex",
         lambda: signature_estimate(s, limits, constraints=[lambda v: cp.norm(v["size[sensor:y1]"]) >= 1])),
        (StructureError, "no fault|none|does not have|asks for",
         lambda: signature_estimate(s, limits, constraints=[lambda v: v["size[sensor:y9]"] >= 1])),
    )


def test_a_healthy_window_gives_nothing(found, limits):
    s = scan(found, window(found, 3))
    result = signature_estimate(s, limits)
    assert not result.alarm and result.clusters == () and not result.near().any()
    search = best_subsets(s, limits, near=result.near())
    assert search.best is None and search.gain == -np.inf and search.margin == np.inf
    assert "no fault gains" in str(search)
