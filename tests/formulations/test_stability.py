"""Stability constraints: exact for na <= 2, a convex inner region above, checked on the roots."""

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from problems import BASIS, plant, record
from refusals import refuses
from systems import nonlinearity

import optid
from formulations.constraints import shape
from formulations.constraints.poles import stable
from optid.errors import StructureError
from optid.models import HammersteinTF
from optid.models.roots import pull_roots
from optid.program.limits import Limit
from optid.program.view import View


def build(rule, na, reference=None, iterate=False):
    """The constraint on a, with its variable."""
    a = cp.Variable(na, name="a")
    view = View({"a": a}, iterate=iterate, channels=("u",), reference={} if reference is None else {"a": reference})
    members = rule.build(view)
    return a, [member.member if isinstance(member, Limit) else member
               for member in (members if isinstance(members, list) else [members])]


def holds(a, members, value):
    a.value = np.asarray(value, dtype=float)
    return all(np.max(member.violation()) <= 1e-12 for member in members)


def largest(a):
    return float(np.max(np.abs(np.roots([1.0, *a])), initial=0.0))


@given(st.lists(st.floats(-2.5, 2.5), min_size=1, max_size=2), st.sampled_from([1.0, 0.9, 0.5]))
def test_the_polytope_is_the_condition_on_the_roots(coefficients, radius):
    a, members = build(stable(radius), len(coefficients))
    size = largest(coefficients)
    if abs(size - radius) > 1e-3:  # a double root moves with the square root of what moves the coefficients
        assert holds(a, members, coefficients) == (size < radius)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("na", [3, 4, 5])
@pytest.mark.parametrize("radius", [1.0, 0.8])
def test_the_inner_region_holds_stable_polynomials_only(na, radius):
    rng = np.random.default_rng(na)
    inside = 0
    for _ in range(12):
        poles = rng.uniform(-1.2, 1.2, na).astype(complex) * radius
        poles[0] = 1.02 * radius * np.exp(1j * rng.uniform(0, 3))
        poles[1] = np.conj(poles[0])
        reference = np.real(np.poly(poles))[1:]
        a, members = build(stable(radius), na, reference)
        centre = pull_roots(reference, 0.98 * radius)
        assert holds(a, members, centre) and largest(centre) < radius
        for size in (0.02, 0.1, 0.4):
            for _ in range(60):
                trial = centre + size * rng.normal(size=na)
                if holds(a, members, trial):
                    inside += 1
                    assert largest(trial) < radius
    assert inside > 100


def near_the_circle(rng, na, distance):
    """Poles in conjugate pairs, clustered and close to the unit circle."""
    angle = rng.uniform(0.1, 3.0)
    pairs = [(1 - distance * rng.uniform(0.5, 2)) * np.exp(1j * (angle + 0.05 * rng.normal())) for _ in range(na // 2)]
    return np.array([*pairs, *np.conj(pairs), *([1 - distance] if na % 2 else [])])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("na", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("distance", [0.3, 1e-2, 1e-3, 1e-5])
def test_a_stable_iterate_lies_in_its_own_region_and_all_of_the_region_is_stable(na, distance):
    rng = np.random.default_rng(na)
    reached = 0
    for _ in range(8):
        radius = float(rng.choice([1.0, 0.9]))
        iterate = np.real(np.poly(radius * near_the_circle(rng, na, distance)))[1:]
        a, members = build(stable(radius), na, iterate, iterate=True)
        assert holds(a, members, iterate)
        for _ in range(25):  # as far as the region reaches in a random direction
            way, low, high = rng.normal(size=na), 0.0, 10.0
            for _ in range(50):
                middle = (low + high) / 2
                low, high = (middle, high) if holds(a, members, iterate + middle * way) else (low, middle)
            assert largest(iterate + low * way) < radius
            reached = max(reached, low * float(np.linalg.norm(way)))
    assert reached > 1e-4 * min(1.0, 100 * distance)


def test_a_tangent_step_from_an_unstable_iterate_is_led_back():
    iterate = np.real(np.poly([1.05, 0.9 + 0.3j, 0.9 - 0.3j]))[1:]
    a, members = build(stable(1.0), 3, iterate, iterate=True)
    cp.Problem(cp.Minimize(cp.sum_squares(a - iterate)), members).solve(solver=cp.CLARABEL)
    assert largest(a.value) < 1


@given(st.lists(st.floats(-2, 2), min_size=2, max_size=4), st.data())
def test_real_roots_are_real_and_separated(coefficients, data):
    na = len(coefficients)
    points = np.array(sorted(data.draw(st.lists(st.floats(-0.8, 0.8), min_size=na - 1, max_size=na - 1, unique=True)),
                             reverse=True))
    if np.min(-np.diff([0.95, *points, -0.95])) < 1e-2:
        return
    a, members = build(stable(0.95, real=points), na)
    inner = np.array([(hi + lo) / 2 for hi, lo in zip([0.95, *points], [*points, -0.95])])
    assert holds(a, members, np.poly(inner)[1:])
    if holds(a, members, coefficients):
        roots = np.roots([1.0, *coefficients])
        assert np.max(np.abs(roots.imag)) < 1e-4 and np.max(np.abs(roots)) < 0.95 + 1e-6


def unstable_record(na):
    """A finite record of a plant whose poles lie a little outside the circle."""
    poles = {1: [1.01], 2: [1.01 * np.exp(0.4j), 1.01 * np.exp(-0.4j)],
             3: [1.005 * np.exp(0.4j), 1.005 * np.exp(-0.4j), 0.5],
             4: [1.005 * np.exp(0.4j), 1.005 * np.exp(-0.4j), 0.5, -0.7]}[na]
    model = HammersteinTF(np.real(np.poly(poles))[1:], ([1.0, 0.4],), (nonlinearity(BASIS, 0, (-1, 1)),), (0,), 0.0)
    return record(model=model, count=120, noise=0.3, seed=2)


@pytest.mark.parametrize("form", ["hammerstein_arx.exact", "hammerstein_arx.overparametrised"])
@pytest.mark.parametrize("na", [1, 2, 3, 4])
def test_unstable_estimates_become_stable_models(na, form):
    data = unstable_record(na)
    free = optid.fit(data, form, na=na, nb=2, basis=BASIS)
    assert not free.model.is_stable
    fit = optid.fit(data, form, na=na, nb=2, basis=BASIS, constraints=["stable"])
    assert fit.model.is_stable
    assert fit.prices[0].binding and fit.prices[0].multiplier > 0
    assert fit.solution.objective > free.solution.objective
    assert fit.solution.objective < 3 * free.solution.objective


@pytest.mark.parametrize("na, radius", [(2, 0.6), (3, 0.7)])
def test_a_pole_radius_binds(na, radius):
    fit = optid.fit(record(), na=na, nb=2, basis=BASIS, constraints=[shape.stable(radius)])
    assert largest(fit.model.a) <= radius + 1e-6
    assert fit.prices[0].binding


def test_real_poles_of_a_fit():
    assert np.iscomplex(plant().poles).all()
    fit = optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=[shape.stable(real=0.55)])
    poles = np.sort(fit.model.poles.real)
    assert np.max(np.abs(fit.model.poles.imag)) < 1e-6
    assert poles[0] <= 0.55 + 1e-6 and poles[1] >= 0.55 - 1e-6


@pytest.mark.parametrize("call, words", [
    (lambda: stable(0.0), r"\(0, 1\]"),
    (lambda: stable(1.5), r"\(0, 1\]"),
    (lambda: build(stable(real=[0.5, 0.6]), 3), "decreasing order"),
    (lambda: build(stable(real=0.5), 3), "2 separating points"),
    (lambda: build(stable(0.5, real=0.7), 2), "inside 0.5"),
    (lambda: optid.fit(record(), na=0, nb=2, basis=BASIS, constraints=["stable"]), "na is 0"),
])
def test_bad_arguments(call, words):
    refuses(StructureError, words, call)
