"""Written by docs/stub.py from the signatures of the formulations; do not edit."""

# ruff: noqa

import collections.abc
import optid.bases.basis
import optid.data.record
import optid.data.streams
import optid.models.equations
import optid.models.hammerstein_ss
from typing import Any, Literal, overload

from optid.data.record import Data as Data
from optid.data.readers import Format as Format
from optid.data.readers import read as read
from optid.data.readers import open_stream as open_stream
from optid.data.streams import Stream as Stream
from optid.data.channels import Transform as Transform
from optid.bases import Triangular as Triangular
from optid.bases import Trigonometric as Trigonometric
from optid.bases import Polynomial as Polynomial
from optid.bases import BSpline as BSpline
from optid.bases import PiecewiseConstant as PiecewiseConstant
from optid.bases import Linear as Linear
from optid.bases import UserFunctions as UserFunctions
from optid.models import Nonlinearity as Nonlinearity
from optid.models import HammersteinSS as HammersteinSS
from optid.models import NoiseCovariances as NoiseCovariances
from optid.models import HammersteinTF as HammersteinTF
from optid.core.problem import Problem as Problem
from optid.program.solution import Status as Status
from optid.program.solution import Solution as Solution
from optid.program.solution import Bound as Bound
from optid.solving.solve import solve as solve
from optid.identify.fitting import resolve as resolve
from optid.identify.fitting import Fit as Fit
from optid.identify.search import Identification as Identification
from optid.identify.selection import path as path
from optid.identify.selection import fit_by_holdout as fit_by_holdout
from optid.identify.validation import validate as validate
from optid.identify.validation import compare_models as compare_models
from optid.identify.validation import fit_by_horizon as fit_by_horizon
from optid.identify.order import order as order
from optid.identify.order import OrderStudy as OrderStudy
from optid.models.equations import Equations as Equations
from optid.models.files import load as load
from optid.identify.recursive import RecursiveARX as RecursiveARX
from optid.faults import Fault as Fault
from optid.identify.resampling import bootstrap as bootstrap
from optid.studies.study import Study as Study
from optid.identify.design import design as design
from optid.identify.design import frequency_response as frequency_response
from optid.identify.search import identify as identify
from optid import signals as signals
from optid import bases as bases
from optid import errors as errors
from optid import examples as examples
from optid import plants as plants
from optid import faults as faults
from optid import studies as studies
from optid.show import plots as plots
from optid.show import report as report
from optid.identify import noise as noise
from optid.identify import tracking as tracking

__version__: str

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["armax.exact"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    nc: int,
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    offset: bool | str = ...,
    starts: int = ...,
    seed: int = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["arx"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    loss: str = ...,
    ridge: float = ...,
    prior: str = ...,
    offset: bool | str = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["bj.exact"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    nc: int,
    nd: int,
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    offset: bool | str = ...,
    starts: int = ...,
    seed: int = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["fir"],
    *,
    nb: int | collections.abc.Sequence[int] = ...,
    nk: int | collections.abc.Sequence[int] = ...,
    prior: str = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    offset: bool | str = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_armax.exact"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    nc: int,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    gauge: Literal['norm', 'gain', 'b0'] = ...,
    offset: bool | str = ...,
    starts: int = ...,
    seed: int = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_arx.exact"] = ...,
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str],
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    loss: str = ...,
    ridge: float = ...,
    curvature: float = ...,
    prior: str = ...,
    gauge: Literal['norm', 'gain', 'b0'] = ...,
    offset: bool | str = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_arx.nuclear"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str],
    nk: int | collections.abc.Sequence[int] = ...,
    weight: float = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    loss: str = ...,
    ridge: float = ...,
    curvature: float = ...,
    prior: str = ...,
    gauge: Literal['norm', 'gain', 'b0'] = ...,
    offset: bool | str = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_arx.overparametrised"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str],
    nk: int | collections.abc.Sequence[int] = ...,
    svd: Literal['whitened', 'plain'] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    loss: str = ...,
    ridge: float = ...,
    curvature: float = ...,
    prior: str = ...,
    gauge: Literal['norm', 'gain', 'b0'] = ...,
    offset: bool | str = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_bj.exact"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    nc: int,
    nd: int,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    gauge: Literal['norm', 'gain', 'b0'] = ...,
    offset: bool | str = ...,
    starts: int = ...,
    seed: int = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_oe.exact"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    gauge: Literal['norm', 'gain', 'b0'] = ...,
    offset: bool | str = ...,
    starts: int = ...,
    seed: int = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_oe.shooting"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    gauge: Literal['norm', 'gain', 'b0'] = ...,
    offset: bool = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_ss.asivid"],
    *,
    nx: int | str = ...,
    block_rows: int | None = ...,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    feedback_basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] | None | collections.abc.Sequence[optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] | None] = ...,
    noise: Literal['white', 'coloured'] = ...,
    iterations: int = ...,
    form: str = ...,
    weighting: str = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    observer: str = ...,
    split: str = ...,
    stability: str = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_ss.exact"],
    *,
    nx: int | str,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    feedback_basis: Any = ...,
    criterion: str = ...,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    offset: bool | str = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_ss.shooting"],
    *,
    nx: int | str,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    feedback_basis: Any = ...,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_ss.sid"],
    *,
    nx: int | str = ...,
    block_rows: int | None = ...,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    noise: Literal['white', 'coloured'] = ...,
    weighting: str = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    observer: str = ...,
    split: str = ...,
    stability: str = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_ss.sivid"],
    *,
    nx: int | str = ...,
    block_rows: int | None = ...,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    feedback_basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] | None | collections.abc.Sequence[optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] | None] = ...,
    instruments: Literal['past', 'inputs', 'inputs+past'] = ...,
    form: str = ...,
    tolerance: float = ...,
    weighting: str = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    observer: str = ...,
    split: str = ...,
    stability: str = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["hammerstein_wiener_ss.exact"],
    *,
    nx: int | str,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    output_basis: Any = ...,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["lfr.exact"],
    *,
    nx: int | str,
    channels: int = ...,
    latent_basis: Any = ...,
    latent: str = ...,
    direct: bool = ...,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    criterion: str = ...,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    seed: int = ...,
    tries: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["lfr.shooting"],
    *,
    nx: int | str,
    channels: int = ...,
    latent_basis: Any = ...,
    latent: str = ...,
    direct: bool = ...,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    seed: int = ...,
    tries: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["oe.exact"],
    *,
    na: int,
    nb: int | collections.abc.Sequence[int],
    nk: int | collections.abc.Sequence[int] = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    offset: bool | str = ...,
    starts: int = ...,
    seed: int = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["physical"],
    *,
    equations: optid.models.equations.Equations | str,
    starts: int = ...,
    seed: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["process.exact"],
    *,
    process: str | collections.abc.Sequence[Any] = ...,
    poles: int = ...,
    zero: bool = ...,
    delay: bool = ...,
    integrator: bool = ...,
    order: str = ...,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    hold: str = ...,
    offset: bool | str = ...,
    drift: bool = ...,
    initial: str = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["ss.exact"],
    *,
    nx: int | str,
    criterion: str = ...,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    offset: bool | str = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["ss.shooting"],
    *,
    nx: int | str,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["subspace.nuclear"],
    *,
    nx: int | str = ...,
    block_rows: int | None = ...,
    basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] = ...,
    feedback_basis: optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] | None | collections.abc.Sequence[optid.bases.basis.Basis | str | collections.abc.Sequence[optid.bases.basis.Basis | str] | None] = ...,
    form: Literal['predictor', 'projection', 'instruments'] = ...,
    weight: float | str | collections.abc.Sequence[float] = ...,
    noise: float | None = ...,
    hold_out: float = ...,
    offset: bool = ...,
    feedthrough: bool | collections.abc.Sequence[bool] = ...,
    observer: str = ...,
    split: str = ...,
    stability: str = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: Literal["wiener_ss.exact"],
    *,
    nx: int | str,
    output_basis: Any = ...,
    block_rows: int | collections.abc.Sequence[int] | None = ...,
    weighting: str = ...,
    feedthrough: bool = ...,
    stability: str = ...,
    initial: optid.models.hammerstein_ss.HammersteinSS | collections.abc.Sequence[optid.models.hammerstein_ss.HammersteinSS] = ...,
    iterations: int = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
) -> Fit: ...

@overload
def fit(
    data: optid.data.record.Data | optid.data.streams.Stream,
    formulation_name: str | collections.abc.Callable[..., Any],
    *,
    solver: Any = ...,
    accuracy: float = ...,
    time_limit: float | None = ...,
    isolate: bool | None = ...,
    prove: bool = ...,
    constraints: collections.abc.Sequence[Any] = ...,
    solver_options: collections.abc.Mapping[str, Any] | None = ...,
    raises: bool = ...,
    **structure: Any,
) -> Fit: ...
