"""Bases against closed forms, scipy's own splines, finite differences and numerical integrals."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from scipy.integrate import quad
from scipy.interpolate import BSpline as Spline

from optid.bases import (
    BSpline,
    Linear,
    PiecewiseConstant,
    Polynomial,
    Triangular,
    Trigonometric,
    UserFunctions,
    from_dict,
    parse,
)
from optid.errors import DataError, LookupFailed, StructureError

CUBE = UserFunctions((lambda u: u, lambda u: u**3), ("u", "u3"), (np.ones_like, lambda u: 3 * u**2))
BASES = [
    Triangular(1), Triangular(7), Trigonometric(3), Polynomial(5), BSpline(5), BSpline(4, degree=2),
    BSpline(6, degree=1), BSpline(3, degree=4), PiecewiseConstant(6), Linear(), CUBE]
FITTED = [basis.with_interval(-0.7, 1.3) for basis in BASES]
SMOOTH = [basis for basis in FITTED if not isinstance(basis, (Triangular, PiecewiseConstant))]


def names(bases):
    return [f"{type(basis).__name__}{basis.size}" for basis in bases]


every = pytest.mark.parametrize("basis", FITTED, ids=names(FITTED))


def complete(basis, u):
    first, weights = basis.local(u)
    table = np.zeros((len(u), basis.full_size))
    for k in range(len(u)):
        table[k, first[k] : first[k] + weights.shape[1]] += weights[k]
    return table


@every
@pytest.mark.parametrize("rule", ["clamp", "linear", "extrapolate"])
def test_values_are_the_complete_family_times_the_contrast(basis, rule):
    basis = replace(basis, outside=rule)
    u = np.random.default_rng(0).uniform(-1.5, 2.0, 300)
    assert basis.values(u) == pytest.approx(complete(basis, u) @ basis.contrast, abs=1e-12)
    assert basis.values(u).shape == (300, basis.size)
    assert basis.contrast.shape == (basis.full_size, basis.size)


@every
def test_no_basis_contains_the_constant(basis):
    columns = basis.values(np.linspace(-0.7, 1.3, 500))
    rest = 1 - columns @ np.linalg.lstsq(columns, np.ones(500))[0]
    assert np.linalg.norm(rest) > 1e-3 * np.sqrt(500)
    assert np.linalg.matrix_rank(np.column_stack([np.ones(500), columns])) == basis.size + 1


@pytest.mark.parametrize("basis", [basis for basis in FITTED if basis.dropped is not None])
def test_complete_local_family_sums_to_one_also_when_extrapolating(basis):
    weights = replace(basis, outside="extrapolate").local(np.linspace(-2, 3, 101))[1]
    assert weights.sum(axis=1) == pytest.approx(np.ones(101), abs=1e-9)


def test_triangular_is_linear_interpolation_and_mu_are_values_less_the_reference():
    basis = Triangular(8).with_interval(-1.0, 3.0)
    mu = np.random.default_rng(1).normal(size=8)
    node_values = np.insert(mu, basis.dropped, 0.0)
    assert basis.nodes[basis.dropped] == 0.0
    u = np.linspace(-2, 4, 400)
    assert basis.values(u) @ mu == pytest.approx(np.interp(u, basis.nodes, node_values), abs=1e-13)
    assert Triangular(4).with_interval(2.0, 6.0).nodes[Triangular(4).with_interval(2.0, 6.0).dropped] == 4.0


def test_triangular_extrapolates_along_the_end_slopes():
    basis = Triangular(5, outside="extrapolate").with_interval(-1.0, 1.0)
    mu = np.random.default_rng(2).normal(size=5)
    slopes = basis.slope_rows() @ mu
    ends = basis.values([-1.0, 1.0]) @ mu
    assert basis.values([-3.0, 4.0]) @ mu == pytest.approx(ends + np.array([-2.0, 3.0]) * slopes[[0, -1]])


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_bspline_equals_scipy_inside_and_extrapolated(degree):
    basis = BSpline(6, degree, outside="extrapolate").with_interval(-0.5, 2.0)
    coefficients = np.random.default_rng(3).normal(size=basis.full_size)
    mu = np.delete(coefficients - coefficients[basis.dropped], basis.dropped)
    spline = Spline(basis.knots, coefficients, degree)
    u = np.linspace(-0.8, 2.2, 200)
    assert basis.values(u) @ mu + coefficients[basis.dropped] == pytest.approx(spline(u), abs=1e-10)
    if degree > 1:
        assert basis.slopes(u) @ mu == pytest.approx(spline.derivative()(u), abs=1e-9)
    assert basis.local(u)[1].shape == (200, degree + 1)


def test_legendre_and_trigonometric_closed_forms():
    v = np.linspace(-1, 1, 50)
    u = 3 + 2 * v
    legendre = np.column_stack([v, 1.5 * v**2 - 0.5, 2.5 * v**3 - 1.5 * v])
    assert Polynomial(3).with_interval(1, 5).values(u) == pytest.approx(legendre)
    expected = [g(np.pi * j * v / 1.25) for j in (1, 2) for g in (np.cos, np.sin)]
    assert Trigonometric(2).with_interval(1, 5).values(u) == pytest.approx(np.column_stack(expected))


def test_piecewise_constant_has_one_level_a_cell_and_the_last_cell_is_closed():
    basis = PiecewiseConstant(4).with_interval(0.0, 4.0)
    first, weights = basis.local([0.0, 0.99, 1.0, 3.5, 4.0, -1.0, 9.0])
    assert first.tolist() == [0, 0, 1, 3, 3, 0, 3]
    assert weights.shape == (7, 1)


@pytest.mark.parametrize("basis", [*SMOOTH, FITTED[1]], ids=names([*SMOOTH, FITTED[1]]))
@pytest.mark.parametrize("rule", ["clamp", "linear", "extrapolate"])
def test_slopes_equal_finite_differences(basis, rule):
    basis = replace(basis, outside=rule)
    u = np.random.default_rng(4).uniform(-1.2, 1.8, 60)
    numeric = (basis.values(u + 1e-6) - basis.values(u - 1e-6)) / 2e-6
    assert basis.slopes(u) == pytest.approx(numeric, abs=2e-6 * np.max(np.abs(numeric)))


@every
def test_beyond_the_interval_it_may_go_on_straight(basis):
    basis = replace(basis, outside="linear")
    ends = np.array([-0.7, 1.3])
    straight = basis.values(ends) + basis.slopes(ends) * np.array([[-0.4], [2.0]])
    digits = 1e-7 if isinstance(basis, UserFunctions) else 1e-12  # slopes of theirs are differences
    assert basis.values(ends + [-0.4, 2.0]) == pytest.approx(straight, abs=digits)


def test_user_slopes_by_differences_when_not_given():
    basis = UserFunctions((np.sin,), ("sine",)).with_interval(-1, 1)
    assert basis.slopes(np.linspace(-1, 1, 20)).ravel() == pytest.approx(np.cos(np.linspace(-1, 1, 20)), abs=1e-9)


def in_cone(rows, rng):
    """A vertex of the cone {rows @ mu >= 0} cut by a box, in a random direction."""
    from scipy.optimize import linprog

    rows = rows / np.abs(rows).max(axis=1, initial=1e-9, keepdims=True)
    mu = linprog(rng.normal(size=rows.shape[1]), A_ub=-rows, b_ub=np.zeros(len(rows)), bounds=(-1, 1)).x
    assert np.min(rows @ mu, initial=0.0) > -1e-8
    return mu


@every
def test_increments_make_f_monotone(basis):
    rng = np.random.default_rng(5)
    u = basis.grid(201 if isinstance(basis, (Trigonometric, UserFunctions)) else 1501)
    for _ in range(5):
        mu = in_cone(basis.increments(), rng)
        assert np.min(np.diff(basis.values(u) @ mu)) >= -1e-7


@every
def test_curvature_makes_f_convex(basis):
    if isinstance(basis, PiecewiseConstant):
        points = basis.centres
    else:
        points = basis.grid(1501 if isinstance(basis, (BSpline, Triangular, Polynomial)) else 201)
    rng = np.random.default_rng(6)
    for _ in range(5):
        mu = in_cone(basis.curvature(), rng)
        assert np.min(np.diff(basis.values(points) @ mu, n=2)) >= -1e-7


@pytest.mark.parametrize("basis", [FITTED[1], BSpline(6, 1).with_interval(0, 1), BSpline(6, 2).with_interval(0, 1)])
def test_shape_rows_are_necessary_up_to_degree_two(basis):
    rng = np.random.default_rng(7)
    u = basis.grid(6001)
    for _ in range(200):
        mu = np.cumsum(np.abs(rng.normal(size=basis.size))) + 0.4 * rng.normal(size=basis.size)
        f = basis.values(u) @ mu
        assert (np.min(np.diff(f)) >= -1e-12) == (np.min(basis.increments() @ mu) >= -1e-9)
        assert (np.min(np.diff(f, n=2)) >= -1e-11) == (np.min(basis.curvature() @ mu) >= -1e-9)


@every
def test_slope_rows_bound_the_slope(basis):
    mu = np.random.default_rng(8).normal(size=basis.size)
    bounds = basis.slope_rows() @ mu
    if isinstance(basis, PiecewiseConstant):
        slopes = np.diff(basis.values(basis.centres) @ mu) / np.diff(basis.centres)
    else:
        slopes = basis.slopes(basis.grid()) @ mu
    assert slopes.max() <= bounds.max() + 1e-9
    assert slopes.min() >= bounds.min() - 1e-9


@pytest.mark.parametrize("basis", [
    Polynomial(5).with_interval(-0.7, 1.3), Polynomial(1).with_interval(2, 3), Polynomial(12).with_interval(-1, 1),
    Triangular(5).with_interval(-1, 2), PiecewiseConstant(400).with_interval(0, 1), BSpline(5, 2).with_interval(-1, 1),
    BSpline(6, 3).with_interval(0, 2)], ids=repr)
def test_bounds_on_rows_are_bounds_between_all_points(basis):
    rng = np.random.default_rng(11)
    lo, hi = basis.interval
    first, last = lo + 0.13 * (hi - lo), lo + 0.71 * (hi - lo)
    u, whole = np.linspace(first, last, 20_001), basis.grid(20_001)
    for _ in range(20):
        mu = rng.normal(size=basis.size)
        values, rows = basis.values(u) @ mu, basis.value_rows(first, last) @ mu
        size = np.ptp(values)
        assert rows.min() - 1e-9 <= values.min() and values.max() <= rows.max() + 1e-9
        assert values.min() - rows.min() < 0.03 * size and rows.max() - values.max() < 0.03 * size
        if isinstance(basis, Polynomial):
            for row, order in ((basis.slope_rows(), 1), (basis.curvature(), 2)):
                true, bounds = basis._derivative(whole, order) @ mu, row @ mu
                size = np.ptp(true) + 1e-9
                assert bounds.min() - 1e-9 * size <= true.min() and true.max() <= bounds.max() + 1e-9 * size
                assert true.min() - bounds.min() < 0.05 * size and bounds.max() - true.max() < 0.05 * size


@pytest.mark.parametrize("basis", SMOOTH + [FITTED[1]], ids=names(SMOOTH + [FITTED[1]]))
def test_penalty_equals_the_numerical_integral(basis):
    mu = np.random.default_rng(9).normal(size=basis.size)
    lo, hi = basis.interval
    slope = lambda u: float((basis.slopes(np.array([u])) @ mu)[0])  # noqa: E731
    kinks = None if not hasattr(basis, "p") else list(np.linspace(lo, hi, basis.p + 1)[1:-1]) or None
    first = quad(lambda u: slope(u) ** 2, lo, hi, points=kinks, limit=300)[0]
    assert mu @ basis.penalty(1) @ mu == pytest.approx(first, rel=1e-7)
    if isinstance(basis, Triangular) or getattr(basis, "degree", 2) == 1:
        node_slopes = basis.slope_rows() @ mu
        cell = (hi - lo) / basis.p
        assert mu @ basis.penalty(2) @ mu == pytest.approx(np.sum(np.diff(node_slopes) ** 2) / cell)
        return
    step = 1e-5
    fine = np.linspace(lo + step, hi - step, 40_001)
    bend = ((basis.slopes(fine + step) - basis.slopes(fine - step)) @ mu) / (2 * step)
    tolerance = 2e-2 if isinstance(basis, UserFunctions) else 1e-3
    assert mu @ basis.penalty(2) @ mu == pytest.approx(np.trapezoid(bend**2, fine), rel=tolerance, abs=1e-9)


@every
def test_missing_samples(basis):
    u = np.array([0.1, np.nan, 0.4])
    first, weights = basis.local(u)
    assert first[1] == 0 and not weights[1].any()
    assert first.dtype == np.int32 and weights.dtype == np.float64
    for table in (basis.values(u), basis.slopes(u)):
        assert np.isnan(table[1]).all() and np.isfinite(table[[0, 2]]).all()
    assert u[0] == 0.1 and np.isnan(u[1])


@every
def test_error_outside_names_sample_and_value(basis):
    basis = replace(basis, outside="error")
    basis.values([-0.7, 1.3])
    refuses(DataError, r"Sample 1 .* 5, outside the interval \[-0.7, 1.3\]", basis.values, [0.0, 5.0])
    refuses(DataError, "Sample 1", basis.slopes, [0.0, 5.0])
    assert basis.is_outside([0.0, 5.0, -2.0, np.nan, 1.3]).sum() == 2


@every
@given(scale=st.floats(1e-3, 1e3), offset=st.floats(-50, 50))
def test_change_of_units(basis, scale, offset):
    if isinstance(basis, UserFunctions):
        refuses(StructureError, "keeps the units", basis.in_units, scale, offset)
        return
    basis = replace(basis, outside="extrapolate")
    new, matrix, constant = basis.in_units(scale, offset)
    u = np.linspace(-0.69, 1.29, 41) + 1e-3
    found = new.values(scale * u + offset) @ matrix + constant
    assert found == pytest.approx(basis.values(u), abs=1e-6 * (1 + 1 / scale))


@pytest.mark.parametrize("basis", BASES[:-1] + FITTED[:-1])
def test_json_round_trip(basis):
    assert from_dict(json.loads(json.dumps(basis.to_dict()))) == basis


def test_user_functions_ask_for_themselves():
    description = json.loads(json.dumps(FITTED[-1].to_dict()))
    refuses(StructureError, r"'u', 'u3'.*functions=", from_dict, description)
    again = from_dict(description, {"u": lambda u: u, "u3": (lambda u: u**3)})
    assert again.values([0.5]) == pytest.approx(np.array([[0.5, 0.125]]))


@pytest.mark.parametrize("text, basis", [
    ("triangular:10", Triangular(10)), ("legendre:4", Polynomial(4)), ("polynomial:4", Polynomial(4)),
    ("BSpline:8:degree=2", BSpline(8, 2)), ("piecewiseconstant:6", PiecewiseConstant(6)), ("linear", Linear()),
    ("trigonometric:5:half_range=1.1:outside=extrapolate", Trigonometric(5, 1.1, outside="extrapolate")),
    ("triangular:8:interval=-1..2.5", Triangular(8, (-1.0, 2.5)))])
def test_parse(text, basis):
    assert parse(text) == basis


@pytest.mark.parametrize("text, error, words", [
    ("triangle:4", LookupFailed, "triangular"), ("triangular", StructureError, "triangular:10"),
    ("triangular:x", StructureError, "cannot be read"), ("triangular:0", StructureError, "an integer from 1 to 5000"),
    ("triangular:4:colour=red", StructureError, "colour"), ("triangular:4:outside=mirror", StructureError, "clamp"),
    ("triangular:4:degree=2", StructureError, "degree"), ("triangular:4:interval=1", StructureError, "cannot be read"),
    ("triangular:4:interval=1..0", StructureError, "interval"), ("linear:3", StructureError, "write linear")])
def test_parse_refuses(text, error, words):
    refuses(error, words, parse, text)


@pytest.mark.parametrize("build", [
    lambda: Triangular(2.5), lambda: Triangular(3, interval=(1, 1)), lambda: Triangular(3, interval=(0, np.inf)),
    lambda: Trigonometric(3, half_range=0.5), lambda: Triangular(3).values([0.0]),
    lambda: Triangular(3).with_interval(0, 1).penalty(3),
    lambda: UserFunctions(()), lambda: UserFunctions((np.sin,), ("a", "b")),
    lambda: UserFunctions((np.ones_like,), ("one",)).with_interval(0, 1),
    lambda: UserFunctions((lambda u: np.sin(u) ** 2, lambda u: np.cos(u) ** 2), ("s", "c")).with_interval(0, 1),
    lambda: UserFunctions((lambda u: 3.0,), ("three",), interval=(0, 1)),
    lambda: from_dict({"type": "triangular", "cells": 3})])
def test_bad_arguments(build):
    with pytest.raises(StructureError):
        build()


def test_constant_input_and_wrong_shape():
    refuses(DataError, "constant at 2", Triangular(3).with_interval, 2.0, 2.0)
    refuses(DataError, "finite", Triangular(3).with_interval, np.nan, 2.0)
    refuses(DataError, r"\(N,\)", Triangular(3).with_interval(0, 1).values, np.zeros((4, 2)))
    assert Triangular(3, interval=(0, 1)).with_interval(5, 6).interval == (0, 1)


@pytest.mark.parametrize("basis", [FITTED[1], BSpline(6, 1).with_interval(0, 1), BSpline(6, 2).with_interval(0, 1)])
def test_shape_rows_are_necessary(basis):
    rng = np.random.default_rng(7)
    u = basis.grid(6001)
    for _ in range(200):
        mu = np.cumsum(np.abs(rng.normal(size=basis.size))) + 0.4 * rng.normal(size=basis.size)
        f = basis.values(u) @ mu
        assert (np.min(np.diff(f)) >= -1e-12) == (np.min(basis.increments() @ mu) >= -1e-9)
        assert (np.min(np.diff(f, n=2)) >= -1e-11) == (np.min(basis.curvature() @ mu) >= -1e-9)
