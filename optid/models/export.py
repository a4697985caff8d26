"""Models for other tools: SciPy, python-control, and CasADi for predictive control."""

import warnings
from dataclasses import replace
from typing import Any, cast

import numpy as np

from optid.arrays import Array
from optid.errors import OptidError, StructureError, nearest
from optid.models.feedback_tables import CELLS, FREE, LEGENDRE, LINEAR, USER, tabulate
from optid.models.nonlinearity import Nonlinearity

DROPPED = 1e-14  # leading coefficients of a numerator that SciPy takes for zero
STATES = ("ss", "physical")  # structures whose linear part is given by its states


def to_dlti(model: Any, output: int | str = 0, input: int | str = 0) -> Any:
    """Return the linear part as a `scipy.signal.dlti` with the model's dt.

    The nonlinearity and the constant are not part of it. A state-space model is returned whole, from every f to every
    output, and a physical one about its operating point. Of a transfer function it is the part from one f to one
    output: with one output a transfer function, with several, or a leading coefficient so small that SciPy would drop
    it, a state-space system. An unknown channel, a name or an index, raises a `StructureError`.
    """
    from scipy.signal import dlti

    o, c = _position(output, model.outputs, "output"), _position(input, model.inputs, "input")
    if model.structure not in STATES and model.l == 1:
        numerator, denominator = _polynomials(model, c)
        if abs(numerator[0]) > DROPPED or not numerator.any():
            return dlti(numerator, denominator, dt=model.dt)
    a, b, c_matrix, d = state_space(model)
    if model.structure in STATES:
        return dlti(a, b, c_matrix, d, dt=model.dt)
    return dlti(a, b[:, [c]], c_matrix[[o]], d[[o]][:, [c]], dt=model.dt)


def to_control(model: Any) -> Any:
    """Return the linear part, from every f to every output, as a python-control system.

    Its inputs are the values of the nonlinearities, "f(u)" of an input "u" (a linear one keeps its name); the constants
    are not part of it. A transfer-function model with one output is a transfer function, every other one a state-space
    system; dead times are poles at 0. The outputs keep their names; a full stop, which python-control reserves, becomes
    an underscore.

    Raises:
        OptidError: python-control is not installed.
    """
    control, names = control_package(), control_names(model)
    if model.structure in STATES or model.l > 1:
        return control.ss(*state_space(model), model.dt, **names)
    pairs = [_polynomials(model, c) for c in range(model.m)]
    return control.tf([[num for num, _ in pairs]], [[den for _, den in pairs]], model.dt, **names)


def control_package() -> Any:
    """Return python-control; refuse where it is not installed (`OptidError`)."""
    try:
        import control
    except ImportError as error:
        raise OptidError("to_control needs python-control: pip install 'optid[control]'") from error
    return control


def control_names(model: Any) -> dict[str, list[str]]:
    """Return the names of the inputs and outputs of a python-control system; see `to_control`."""
    places = list(getattr(model, "input_of", range(model.m)))
    drives = [model.inputs[i] if f.is_linear else f"f{places[:k].count(i) + 1 if places.count(i) > 1 else ''}"
              f"({model.inputs[i]})" for k, (f, i) in enumerate(zip(model.nonlinearities, places))]
    return {"inputs": [name.replace(".", "_") for name in drives or model.inputs],
            "outputs": [name.replace(".", "_") for name in model.outputs]}


def to_casadi(model: Any) -> Any:
    """Return a model as a `casadi.Function` (x, u) -> (x_next, y), the free run without noise.

    x is the state of a state-space model. Of a transfer function it has n l entries, n = `model.largest_lag`: the rows
    of the state (n, l) one after the other, row i being what the past adds to the equation i samples ahead; start from
    `model.state(u, y)` flattened row by row, or from zeros. The constants are part of x_next and y. Outside the
    interval of its basis f is clamped or extrapolated as chosen (outside="error" clamps, since a symbolic function
    cannot raise). Iterating equals `model.simulate`.

    Raises:
        StructureError: a basis of UserFunctions that cannot be called with a CasADi scalar.
    """
    import casadi as ca

    a, b, c, d = (ca.sparsify(ca.DM(matrix)) for matrix in state_space(model))
    x, u = ca.MX.sym("x", a.shape[0]), ca.MX.sym("u", model.m)
    places = getattr(model, "input_of", range(model.m))
    f = ca.vertcat(*(symbolic(f, u[i]) for f, i in zip(model.nonlinearities, places)))
    y, following = c @ x + d @ f, a @ x + b @ f
    if model.structure == "ss":
        y += ca.DM(model.offset_y)
        z = ca.DM(model.Cz) @ x + ca.DM(model.Dz) @ u + ca.DM(model.offset_z)
        for j, h in enumerate(model.latent):
            inner = symbolic(h, z[j])
            y, following = y + ca.DM(model.Fz[:, j]) * inner, following + ca.DM(model.Ez[:, j]) * inner
        following += ca.DM(model.L) @ y + ca.DM(model.offset_x)
        for j, (g, o) in enumerate(zip(model.feedback, model.output_of)):
            following += ca.DM(model.E[:, j]) * symbolic(g, y[o])
    else:
        y += ca.DM(model.offset)
        constant = np.zeros((model.largest_lag, model.l))
        constant[: model.na] = -model.matrices @ model.offset
        following += ca.DM(constant.ravel())
    name = "hammerstein_ss" if model.structure == "ss" else "hammerstein_tf"
    return ca.Function(name, [x, u], [following, y], ["x", "u"], ["x_next", "y"])


def state_space(model: Any) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D of the linear part, of a transfer function in observer form with n l states."""
    if model.structure == "ss":
        return model.A, model.B, model.C, model.D
    if model.structure == "physical":
        return model.matrices
    n, outputs = model.largest_lag, model.l
    rows = model.numerators.copy()
    a, b = np.eye(n * outputs, k=outputs), rows[1:].reshape(n * outputs, model.m)
    for i, matrix in enumerate(model.matrices):
        at = slice(i * outputs, (i + 1) * outputs)
        a[at, :outputs] -= matrix
        b[at] -= matrix @ rows[0]
    return a, b, np.eye(outputs, n * outputs), rows[0]


def symbolic(nonlinearity: Nonlinearity, u: Any) -> Any:
    """Write f of a CasADi scalar as an expression, the constant included.

    Raises:
        StructureError: a basis without a symbolic form.
    """
    import casadi as ca

    tables = tabulate([nonlinearity])
    kind, low, high, numbers = tables.kind[0], float(tables.low[0]), float(tables.high[0]), tables.numbers[0]
    if kind == USER and not tables.outside[0] == LINEAR:
        return _called(nonlinearity, u if tables.outside[0] == FREE else ca.fmin(ca.fmax(u, low), high))
    if tables.outside[0] == LINEAR:
        slope = nonlinearity.slope(np.array([low, high]))
        inside = symbolic(Nonlinearity(replace(cast(Any, nonlinearity.basis), outside="clamp"), nonlinearity.mu,
                                       nonlinearity.offset), u)
        return inside + float(slope[0]) * ca.fmin(u - low, 0) + float(slope[1]) * ca.fmax(u - high, 0)
    if tables.outside[0] != FREE:
        u = ca.fmin(ca.fmax(u, low), high)
    f: Any = nonlinearity.offset or 0.0
    if nonlinearity.is_linear:
        return float(nonlinearity.mu[0]) * u + f
    if kind == CELLS:
        return _piecewise(numbers, (u - low) * (len(numbers) / (high - low))) + f
    if kind == LEGENDRE:
        v = (2 * u - low - high) / (high - low)
        previous, current = 1.0, v
        for k, weight in enumerate(numbers[:, 0], start=1):
            f = f + float(weight) * current
            previous, current = current, ((2 * k + 1) * v * current - k * previous) / (k + 1)
        return f
    angle = float(tables.rate[0]) * (u - (low + high) / 2)
    for k, (cosine, sine) in enumerate(numbers, start=1):
        f = f + float(cosine) * ca.cos(k * angle) + float(sine) * ca.sin(k * angle)
    return f


def _called(nonlinearity: Nonlinearity, u: Any) -> Any:
    """Call functions of the user with a CasADi scalar, and compare the values with those of arrays at a few points."""
    import casadi as ca

    basis = cast(Any, nonlinearity.basis)
    weights = basis.contrast @ nonlinearity.mu
    scalar = ca.MX.sym("u")
    try:
        with warnings.catch_warnings():  # CasADi announces another kind of result for arrays; scalars stay scalars
            warnings.simplefilter("ignore", FutureWarning)
            values = [function(scalar) for function in basis.functions]
        f = ca.Function("f", [scalar], [sum(float(w) * value for w, value in zip(weights, values))])
    except Exception as error:  # the user's function may fail in any way on what is no array
        raise StructureError(
            f"{type(basis).__name__} cannot be called with a CasADi scalar ({type(error).__name__}: {error}): write it "
            "in arithmetic and NumPy functions, or fit the model again with BSpline or Triangular.") from None
    low, high = basis.interval or (-1.0, 1.0)
    points = np.linspace(low, high, 7)
    expected = replace(nonlinearity, offset=0.0)(points)
    found = np.array(f(points[None])).ravel()
    if not np.allclose(found, expected, rtol=1e-9, atol=1e-9 * float(np.max(np.abs(expected)))):
        raise StructureError(f"{type(basis).__name__} has other values for a CasADi scalar than for an array: write it "
                             "in arithmetic and NumPy functions, or fit the model again with BSpline or Triangular.")
    return f(u) + (nonlinearity.offset or 0.0)


def _piecewise(pieces: Array, x: Any) -> Any:
    """One polynomial per cell in the position within the cell; the end cells reach outwards."""
    import casadi as ca

    f = None
    for cell, coefficients in enumerate(pieces):
        piece = float(coefficients[0])
        for coefficient in coefficients[1:]:
            piece = piece * (x - cell) + float(coefficient)
        f = piece if f is None else ca.if_else(x >= cell, piece, f)
    return f


def _polynomials(model: Any, c: int) -> tuple[Array, Array]:
    """Numerator without leading zeros and denominator in powers of z, for one output."""
    numerator, denominator = model.numerators[:, 0, c], np.eye(1, model.largest_lag + 1)[0]
    denominator[1 : model.na + 1] = model.a
    return np.trim_zeros(numerator, "f") if numerator.any() else np.zeros(1), denominator


def _position(channel: int | str, names: tuple[str, ...], kind: str) -> int:
    if isinstance(channel, str):
        if channel not in names:
            raise StructureError(f"No {kind} {channel!r}. {nearest(channel, names)}")
        return names.index(channel)
    if not 0 <= channel < len(names):
        raise StructureError(f"{kind} {channel}: there are {len(names)}, counted from 0.")
    return channel
