"""Set membership: the least factor of a plain linear programme, proofs added up by hand, none of them false."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from fault_plants import LOAD, levels, noisy, record, refused
from scipy.optimize import linprog
from test_fault_injection import small

from optid import Data
from optid.backends import Answer, BackEnd, find
from optid.errors import DataError, StructureError
from optid.faults import Fault, dictionary, inject, membership
from optid.faults.consistency.bounded_noise import bounded_window, parity_proof
from optid.program.solution import Status

N = 20


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD}, kinds=["bias", "loss", "drift", "noise", "spike"])


def window(found, seed, faults=(), missing=0.0):
    return record(found.model, seed, faults, missing, N)


def dense(model, data, process, output, extra=None):
    """The same linear programme without any of the library's forms: states, sizes and t as plain columns."""
    part = data.experiments[0]
    u, y, count, n = part.u, part.y, len(part.y), model.nx
    into_state, into_output = extra or (np.zeros((count, n, 0)), np.zeros((count, model.l, 0)))
    f, size, rows = model.expand_inputs(u), count * n + into_state.shape[2], []
    for k in range(count - 1):
        if model.L.any() and np.isnan(y[k]).any():
            continue  # what is fed back is not known
        for i in range(n):
            row = np.zeros(size)
            row[(k + 1) * n + i] = 1.0
            row[k * n : (k + 1) * n] -= model.A[i]
            row[count * n :] = -into_state[k + 1, i]
            known = model.B[i] @ f[k] + model.offset_x[i] + model.L[i] @ np.nan_to_num(y[k])
            rows.append((row, known, process[i]))
    for k, o in np.argwhere(~np.isnan(y)):
        row = np.zeros(size)
        row[k * n : (k + 1) * n] = model.C[o]
        row[count * n :] = into_output[k, o]
        rows.append((row, y[k, o] - model.D[o] @ f[k] - model.offset_y[o], output[o]))
    matrix, level, bounds = (np.array(part) for part in zip(*rows))
    A = np.vstack([np.hstack([matrix, -bounds[:, None]]), np.hstack([-matrix, -bounds[:, None]])])
    cost = np.zeros(A.shape[1])
    cost[-1] = 1.0
    return linprog(cost, A, np.concatenate([level, -level]), bounds=[(None, None)] * (A.shape[1] - 1) + [(0, None)]).fun


def by_hand(model, data, proof, process, output):
    """Add the proof up with loops over the samples; return the sum, what it may be at most, and the weight of x(0)."""
    part, p = data.experiments[0], proof.weights
    f, x, total = model.expand_inputs(part.u), np.zeros(model.nx), 0.0
    for k in range(len(part.y)):
        e = part.y[k] - model.C @ x - model.D @ f[k] - model.offset_y
        total += float(np.nansum(p[k] * e))
        x = model.A @ x + model.B @ f[k] + model.offset_x
    q, most = np.zeros(model.nx), 0.0
    for k in range(len(part.y) - 1, -1, -1):
        most += float(np.abs(p[k]) @ output + np.abs(q) @ process)
        q = model.A.T @ q + model.C.T @ p[k]
    return abs(total), most, float(np.abs(q).max())


def sigmas(model, times):
    return [times * np.sqrt(np.diag(c)) for c in (model.noise.Q, model.noise.R)]


def agreeing(model, data, bounds, **how):
    """The membership of a window, whose factor is that of the plain programme and proved."""
    result = membership(model, data, bounds, **how)
    noise = bounds.values() if isinstance(bounds, dict) else sigmas(model, bounds)
    assert result.factor == pytest.approx(dense(model, data, *noise), rel=1e-6)
    assert result.proof.factor == pytest.approx(result.factor, rel=1e-6) and not result.status
    assert result.impossible == (result.factor > 1)
    return result


@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("solver", ["auto", "highs"])
def test_the_factor_is_that_of_a_plain_programme(found, missing, solver):
    for seed, size in ((1, 0.0), (2, 1.5)):
        data = window(found, seed, Fault.step("sensor:y1", 8, size) if size else [], missing)
        assert agreeing(found.model, data, 2.0, solver=solver).proof.rounding < 1e-6


def test_the_proof_adds_up_by_hand(found):
    process, output = sigmas(found.model, 2.0)
    for seed in range(4):
        data = window(found, seed, Fault.step("sensor:y1", 8, 2.0), missing=0.1 * (seed % 2))
        result = membership(found.model, data, 2.0)
        total, most, start = by_hand(found.model, data, result.proof, process, output)
        assert result.impossible and total > most and start < 1e-9
        assert total / most == pytest.approx(result.factor, rel=1e-6)
        assert result.parity_vector.shape == (N, 2)


def test_noise_within_its_bounds_never_exceeds_a_proof(found):
    """Whatever the vector: no plant whose noise keeps its bounds adds up to more, whatever its start."""
    model, rng = found.model, np.random.default_rng(0)
    process, output = sigmas(model, 1.5)
    u = levels(N, 1)
    f = model.expand_inputs(u)
    largest = 0.0
    for _ in range(60):
        x, y = 20 * rng.standard_normal(3), np.empty((N, 2))
        for k in range(N):
            y[k] = model.C @ x + model.D @ f[k] + model.offset_y + output * rng.choice([-1, 1], 2)
            x = model.A @ x + model.B @ f[k] + model.offset_x + process * rng.choice([-1, 1], 3)
        window = bounded_window(model, Data(u, y), 1.5)
        for p in (rng.standard_normal((N, 2)), rng.standard_normal((N, 2)) * (rng.random((N, 2)) < 0.2)):
            largest = max(largest, parity_proof(window, p, window.unseen()).factor)
        assert not membership(model, Data(u, y), 1.5, solver="highs").impossible
    assert 0.1 < largest <= 1.0


def test_no_false_proof_and_no_false_exclusion(found):
    kinds = {"actuator:u1": Fault.step, "sensor:y2": Fault.step, "sensor:y1 drift": Fault.ramp,
             "sensor:y1 spike": partial(Fault.step, end=10)}
    for seed, (label, make) in enumerate(kinds.items()):
        assert not membership(found.model, window(found, seed), solver="highs").impossible
        data = window(found, seed, make(found[label].name, 9, 0.4 if make == Fault.ramp else 2.5))
        few = replace(found, candidates=tuple(found[c] for c in (label, "sensor:y1", "actuator:u2")))
        result = membership(found.model, data, 3.0, few, solver="highs")
        assert result.impossible and label in result.consistent


@pytest.mark.slow
def test_candidates_against_all_onsets_by_plain_programmes(found):
    data = window(found, 5, Fault.step("sensor:y2", 9, 2.0))
    process, output = sigmas(found.model, 2.0)
    u = data.experiments[0].u
    few = replace(found, candidates=tuple(found[c] for c in (
        "actuator:u1", "sensor:y1", "sensor:y2", "actuator:u1 loss", "sensor:y2 drift", "state")))
    result = membership(found.model, data, 2.0, few, solver="highs")
    for c in few.candidates:
        values = [dense(found.model, data, process, output, few.additions(c, N, k, u)) for k in range(N)]
        t = result.candidates[c.label]
        assert (t > 1) == (min(values) > 1), c.label
        if t <= 1:
            assert t == pytest.approx(values[result.onsets[c.label]], rel=1e-6)
        else:  # what is proved is a bound, and the proofs cover all onsets
            assert t <= min(values) * (1 + 1e-6)
            covered = {k for first, last in result.proofs[c.label] for k in range(first, last + 1)}
            assert covered == set(range(N)) and all(p.proved for p in result.proofs[c.label].values())
    assert "sensor:y2" in result.consistent and len(result.consistent) < len(few.candidates)
    whole = membership(found.model, data, 2.0, found, onsets="course", solver="highs")
    assert set(whole.untested) == {"sensor:y1 noise", "sensor:y2 noise", "process:load noise", "sensor:y1 loss",
                                   "sensor:y2 loss"}
    assert set(result.consistent) <= set(whole.consistent)
    for text in (str(result), str(whole), str(result.proof)):
        assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("missing", [0.0, 0.15])
def test_outputs_that_are_fed_back(found, missing):
    """A step from a sample whose reading is missing is unknown: the state after it is another start."""
    model = replace(found.model, L=0.1 * np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]]))
    u = levels(N, 3)
    y = inject(model, u, Fault.step("sensor:y1", 8, 1.0), seed=3)
    y[np.random.default_rng(3).random(y.shape) < missing] = np.nan
    assert agreeing(model, Data(u, y), 1.5).window.steps.all() == (not missing)


def test_states_without_noise_are_equations():
    model = noisy([[0.8, 0.1], [0.0, 0.5]], [[1.0], [0.0]], [[1.0, 0.0], [0.0, 1.0]], np.diag([0.01, 0.04]),
                  0.01 * np.eye(2))
    u = levels(N, 1, m=1)
    agreeing(model, Data(u, inject(model, u, seed=1)), {"process": [0.3, 0.0], "output": [0.3, 0.3]})


def test_constraint_names_only_raise_the_factor(found):
    data = window(found, 2, Fault.step("sensor:y1", 8, 1.0))
    free = membership(found.model, data, solver="highs")
    held = membership(found.model, data, constraints=[lambda v: {"start": v["x"][0] == 0}])
    assert held.factor >= free.factor - 1e-9
    assert held.proof.factor <= held.factor * (1 + 1e-9)


def test_a_solver_that_lies_proves_nothing(found):
    data = window(found, 1)

    def liar(program, settings):
        answer = find("highs").run(program, settings)
        wild = {name: 1e3 * np.random.default_rng(0).standard_normal(d.shape) for name, d in answer.duals.items()}
        return Answer(Status.OPTIMAL, "optimal", {**answer.values, "t": np.asarray(7.0)}, wild)

    result = membership(found.model, data, solver=BackEnd("liar", frozenset({"LP"}), liar))
    assert not result.impossible and result.proof.factor <= membership(found.model, data).factor * (1 + 1e-9)
    assert result.status

    def short(program, settings):
        return replace(find("highs").run(program, settings), duals={"noise": np.ones(3)})

    mute = membership(found.model, data, solver=BackEnd("mute", frozenset({"LP"}), short))
    assert not mute.impossible  # its point still counts, with multipliers of ours


def test_a_solver_that_fails_excludes_nothing(found):
    data = window(found, 1, Fault.step("sensor:y1", 8, 2.0))
    broken = BackEnd("broken", frozenset({"LP"}), lambda *_: Answer(Status.FAILED, "no memory"))
    result = membership(found.model, data, 2.0, replace(found, candidates=found.candidates[:2]), solver=broken)
    assert not result.impossible and result.parity_vector is None
    assert set(result.consistent) == set(found.labels[:2])
    assert all(np.isnan(t) for t in result.candidates.values()) and "no memory" in str(result)


def test_bad_input(found):
    model, data = found.model, window(found, 1)
    broken = data.u.copy()
    broken[3, 1] = np.nan
    several = Data([levels(N, 0)] * 2, [np.zeros((N, 2))] * 2)
    refused(*((error, words, lambda p=plant, r=given, how=how: membership(p, r, **how))
              for error, words, plant, given, how in (
        (StructureError, "'output'", model, data, {"bounds": {"process": [1, 1, 1]}}),
        (StructureError, "shape", model, data, {"bounds": {"process": [1, 1], "output": [1, 1]}}),
        (StructureError, "negative", model, data, {"bounds": {"process": [1, 1, -1], "output": [1, 1]}}),
        (StructureError, "all are zero", model, data, {"bounds": {"process": [0, 0, 0], "output": [0, 0]}}),
        *(((StructureError, TypeError), "bounds|isfinite", model, data, {"bounds": b})
          for b in (0.0, -1.0, np.nan, "wide", type)),
        (StructureError, "no noise covariances", replace(model, noise=None), data, {}),
        *((StructureError, "onsets", model, data, {"faults": found, "onsets": k}) for k in ("some", [], [N], [-1])),
        (DataError, "one at a time", model, several, {}),
        (DataError, "'u2' is missing at sample 3", model, Data(broken, data.y), {}))))
