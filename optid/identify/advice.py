"""Advice on how to improve a model: steps with a reason and, where it is cheap to try, with their gain.

The record is checked first; then neighbouring structures are fitted.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import OptidError
from optid.identify.blocks import Blocks
from optid.identify.informativity import Informativity, informativity
from optid.identify.lag_sums import LagSums
from optid.identify.validation.checks import shares_outside
from optid.identify.validation.predictions import SIMULATION, fit_percent, prediction_fit, simulated_or_nan
from optid.models.functions import has_feedback

MOST = 5
WORTH = 0.1  # reduction of the simulation error, as a share, from which a step is advised
SPARED = 0.5  # points of fit that may be lost for a simpler structure
JUMP = 4.0  # ratio of the sizes of a channel's steps before and after a sample that counts as a change
APART = 15.0  # points by which both halves of a record fit better alone, from which the plant counts as changed
DRIVEN = 0.5  # log ratio by which past outputs reduce the error of the input, from which columns count as swapped
TOO_FEW = 10  # samples per parameter at least
UNSTABLE = "the model has a pole outside the unit circle"
SLOW = 0.9  # real poles from here on are compared with 1
FEW = 8  # moves of the inputs below which a record determines a process, and little more
LONG = 20_000  # samples beyond which no neighbouring structure is tried
NOISE_MODELS = ("arx", "hammerstein_arx", "armax", "hammerstein_armax", "bj", "hammerstein_bj")
# what a state-space model of a closed loop is fitted by
PREDICTOR = "--formulation ss.exact --set criterion=prediction --set feedthrough=false"
# formulations with a static function of the input, by those without
STATIC = {"arx": "hammerstein_arx.exact", "oe.exact": "hammerstein_oe.exact", "ss.exact": "hammerstein_ss.exact"}


@dataclass(frozen=True)
class Advice:
    """A recommended step.

    Attributes:
        sentence: the finding, and the effect of the step.
        step: an option of the command line, or a call.
        gain: points of simulation fit gained where that was tried; NaN where not.
    """

    sentence: str
    step: str
    gain: float = np.nan

    def __str__(self) -> str:
        return f"{self.sentence}: {self.step}"


def advise(fit: Any) -> tuple[Advice, ...]:
    """Return at most five steps for a fit of a record in memory, the most useful first."""
    if not isinstance(fit.data, Data) or not fit.data.is_regular or fit.model is None:
        return ()
    told = informativity(fit.data)
    steps = [*_hopeless(told), *_in_a_loop(fit, told), *_on_record(fit), *_on_steps(fit, told)]
    # in a loop a free run says nothing about the plant, by which neighbours are compared
    tried = list(_tried(fit)) if fit.data.n_samples <= LONG and told.loop.word == "open" else []
    while tried:  # of steps with nearly the same gain, the simplest, which was tried first
        best = max(one.gain for one in tried)
        tried.remove(first := next(one for one in tried if one.gain >= best - SPARED))
        steps.append(first)
    found: dict[str, Advice] = {}
    for one in (*steps, *_on_model(fit)):
        found.setdefault(one.step, one)
    return tuple(found.values())[:MOST]


def _hopeless(told: Informativity) -> Iterator[Advice]:
    """Repeat why nothing can be identified, and what to do."""
    if told.reason:
        what, _, step = told.reason.partition("; " if "; " in told.reason else ": ")
        yield Advice(what, step or "choose other columns, or record more")


def _in_a_loop(fit: Any, told: Informativity) -> Iterator[Advice]:
    """Advise a noise model and lags from 1 on where an output acts on an input."""
    if told.loop.word == "open" or not told.processes:
        return
    states = hasattr(fit.model, "D")
    direct = bool(np.any(fit.model.D)) if states else hasattr(fit.model, "nk") and min(fit.model.nk) == 0
    described = states and fit.arguments.get("criterion") == "prediction"
    if direct or not (described or fit.formulation.startswith(NOISE_MODELS)):
        na = max(r.poles.size for p in told.processes for r in p.responses)
        nk = " ".join(str(max(lag, 1)) for lag in told.lags)
        step = (f"--formulation bj.exact --na {na} --nb 1 --nk {nk} --set nc=1 --set nd=1"
                if fit.data.l == 1 and not states else PREDICTOR)
        what = "an input that acts at once is the controller's answer" if direct else (
            f"{fit.formulation} assumes that the inputs do not depend on the noise")
        yield Advice(f"the loop was closed, and {what}: use a noise model and lags from 1 on", step)


def _on_record(fit: Any) -> Iterator[Advice]:
    data: Data = fit.data.raw()
    yield from _swapped(data)
    for role, names in (("input", data.inputs), ("output", data.outputs)):
        for c, name in enumerate(names):
            yield from _jump(role, name, [(e.u if role == "input" else e.y)[:, c] for e in data.experiments])
    outliers = [sentence for sentence in fit.findings if " outlier" in sentence]
    if outliers:
        yield Advice(outliers[0].partition(":")[0], "--loss huber, or mark them as missing")
    yield from _halves(fit)


def _on_steps(fit: Any, told: Informativity) -> Iterator[Advice]:
    """Point to a process model where few moves show a dead time, of which a transfer function has whole samples."""
    processes = told.processes
    if told.loop.word != "open" or told.reason or not processes or fit.model.structure == "process" or fit.data.l > 1:
        return
    late = [r.nk - 1 for r in processes[0].responses]
    if told.moves < FEW and max(late) > 0:
        poles = max(min(max((r.poles != 1).sum() for r in processes[0].responses), 3), 1)
        yield Advice(f"the inputs move {told.moves} times and the output answers {max(late)} samples late: gain, time "
                     "constants and dead time in seconds, no matter how it is sampled, are those of a process model",
                     f"--formulation process.exact --process P{poles}D")


def _swapped(data: Data) -> Iterator[Advice]:
    """Detect an input that past outputs explain, while its own past does not explain them."""
    if data.m != 1 or data.l != 1:
        return
    turned = Data([e.y for e in data.experiments], [e.u for e in data.experiments], dt=data.dt, inputs=data.outputs,
                  outputs=data.inputs)
    try:
        forward, backward = _drive(data), _drive(turned)
    except OptidError:
        return
    if backward > DRIVEN and forward < 0.1 * backward:
        yield Advice(f"the past of {data.outputs[0]!r} explains {data.inputs[0]!r}, but not conversely: input and "
                     "output may be swapped", f"--inputs {data.outputs[0]} --outputs {data.inputs[0]}")


def _drive(data: Data) -> float:
    """Return the reduction of the log one-step error of the output by past inputs."""
    sums = LagSums(Blocks.of(data), na=6, lags=8)
    with_input = sums.columns(sums.layout.na, sums.layout.nb[0] - 1, (1,))
    alone = np.concatenate([with_input[: sums.layout.na], with_input[-1:]])
    return float(np.log(max(sums.remainder(alone), 1e-12) / max(sums.remainder(with_input), 1e-12)))


def _jump(role: str, name: str, records: list[Array]) -> Iterator[Advice]:
    """Detect a sample from which on a channel varies many times as much, or as little, as before."""
    for i, x in enumerate(records):
        steps = np.abs(np.diff(x[np.isfinite(x)]))
        if steps.size < 128:
            continue
        sizes = np.array([np.sqrt(np.mean(part**2)) for part in np.array_split(steps, 16)])
        if not sizes.min() > 0:
            continue
        ratio, at = max((max(sizes[k:].min() / sizes[:k].max(), sizes[:k].min() / sizes[k:].max()), k)
                        for k in range(3, 14))
        if ratio > JUMP:
            factor, sample = np.median(sizes[at:]) / np.median(sizes[:at]), at * len(x) // 16
            where = f" of experiment {i + 1}" if len(records) > 1 else ""
            yield Advice(f"{role} {name!r} varies {factor:.3g} times as much from about sample {sample}{where} on: its "
                         "unit or its gain may have changed there", f"data.window(0, {sample}) is the part before")
            return


def _halves(fit: Any) -> Iterator[Advice]:
    """Fit both halves alone: where both fits are much better, the plant changes."""
    data: Data = fit.data
    if data.n_experiments > 1 or not 200 <= data.n_samples <= LONG:
        return
    middle = data.n_samples // 2
    parts = data.split(middle)
    whole = simulated_or_nan(fit.model, data.raw())[0]
    before = [float(np.mean(fit_percent(p.raw().experiments[0].y, w))) for p, w in
              zip(parts, (whole[:middle], whole[middle:]))]
    alone = [_try(fit, data=part) for part in parts]
    if all(one is not None for one in alone):
        after = [_score(one.model, part) for one, part in zip(alone, parts)]
        if min(a - b for a, b in zip(after, before)) > APART:
            yield Advice(f"fitted alone, the halves of the record reach {after[0]:.0f} and {after[1]:.0f} % instead of "
                         f"{before[0]:.0f} and {before[1]:.0f} %: the plant changes within the record",
                         f"data.split({middle}) gives both")


def _tried(fit: Any) -> Iterator[Advice]:
    """Fit neighbouring structures; those that reduce the simulation error much are advised."""
    before = _score(fit.model, fit.data)
    for sentence, step, changes in _neighbours(fit):
        after = before if (found := _try(fit, **changes)) is None else _score(found.model, fit.data)
        if after - before > WORTH * (100 - before):
            yield Advice(f"{sentence} raises the simulation fit from {before:.0f} to {after:.0f} %", step,
                         after - before)


def _neighbours(fit: Any) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield structures as a phrase, as options, and as changes of the arguments of a fit."""
    name, arguments, data = fit.formulation, fit.arguments, fit.data
    binding = [price.name for price in fit.prices if price.binding]
    held = [rule for rule in arguments.get("constraints", ()) if not any(
        word == getattr(rule, "name", "") or word.startswith(f"{getattr(rule, 'name', ' ')} of ") for word in binding)]
    if len(held) < len(arguments.get("constraints", ())):
        words = ", ".join(map(repr, binding))
        yield f"leaving out {words}, which bind{'s' * (len(binding) == 1)},", f"without {words}", {"constraints": held}
    if hasattr(fit.model, "nk") and "nb" in arguments:
        told = informativity(data)
        shown = [told.lags] if told.processes else []
        found = [(told.least,) * data.m, *(k for lags in shown for k in (
            lags, tuple(max(lag - 1, told.least) for lag in lags)))]
        for delay in dict.fromkeys(found):
            if delay != tuple(fit.model.nk):
                words = _words(delay)
                yield f"a delay of {words} sample{'s' * (words != '1')}", f"--nk {words}", {"nk": list(delay)}
    for more in (1, 2):
        if "na" in arguments and "nb" in arguments:
            na, nb = arguments["na"] + more, _more(arguments["nb"], more)
            yield f"a higher order (na {na}, nb {_words(nb)})", f"--na {na} --nb {_words(nb)}", {"na": na, "nb": nb}
    for more in (1, 2):
        if isinstance(arguments.get("nx"), int):
            nx = arguments["nx"] + more
            yield f"a higher order (nx {nx})", f"--nx {nx}", {"nx": nx}
    if arguments.get("offset") is False:
        yield "an estimated constant", "--set offset=true", {"offset": True}
    static = "hammerstein" in name
    if data.l == 1 and "arx" in name and "armax" not in name and "na" in arguments:
        other = "hammerstein_oe.exact" if static else "oe.exact"
        kept = {key: arguments[key] for key in ("na", "nb", "nk", "constraints", "basis") if key in arguments}
        yield ("fitting the simulation instead of the one-step prediction", f"--formulation {other}",
               {"formulation": other, "replaced": kept})
    several = all(np.unique(e.u[:, c]).size > 2 for e in data.experiments for c in range(data.m))
    if name in STATIC and several:
        yield ("a static function of the input", f"--formulation {STATIC[name]} --basis triangular:6",
               {"formulation": STATIC[name], "basis": "triangular:6"})
    if not has_feedback(fit.model) and not getattr(fit.model, "latent", ()):
        basis = arguments.get("basis", "linear") if static else "linear"
        yield ("a static function of the output that is fed back",
               "--formulation hammerstein_ss.exact --nx 2 --feedback-basis polynomial:3",
               {"formulation": "hammerstein_ss.exact",
                "replaced": {"nx": 2, "basis": basis, "feedback_basis": "polynomial:3", "iterations": 30}})


def _on_model(fit: Any) -> Iterator[Advice]:
    model, data = fit.model, fit.data.raw()
    yield from advise_on_poles(fit)
    for function, x, share in shares_outside(model, data):
        if share > 0.01 and function.family != "latent":
            yield Advice(f"{100 * share:.0f} % of {function.name} lies outside the interval of its basis",
                         f"--basis ...:interval={np.nanmin(x):.4g},{np.nanmax(x):.4g}")
    count = fit.data.n_samples * fit.data.l
    parameters = sum(np.size(value) for _, value in model.coefficients())
    if count < TOO_FEW * parameters:
        yield Advice(f"{count} samples are few for {parameters} coefficients", "fewer lags or basis functions, or a "
                     "longer record")
    if float(fit.figures.get("condition", 1.0)) > 1e7:
        yield Advice("the inputs do not excite all lags (condition number above 1e7)", "optid design designs an input")
    plain = {other: name for name, other in STATIC.items()}.get(fit.formulation)
    if plain is None or has_feedback(model):
        return
    kept = {key: value for key, value in fit.arguments.items() if key in ("na", "nb", "nk", "nx", "offset")}
    found = _try(fit, formulation=plain, replaced=kept)
    if found is not None and _score(found.model, fit.data) > _score(model, fit.data) - SPARED:
        yield Advice("a linear function of the input fits as well", f"--formulation {plain}")


def advise_on_poles(fit: Any) -> Iterator[Advice]:
    """Tell a pole that the record does not tell from 1, an integrator, from one outside the unit circle."""
    model = fit.model
    if has_feedback(model) or any("integrator" in getattr(rule, "about", ()) for rule in fit.arguments.get(
            "constraints", ())):
        return
    slow = [pole.real for pole in model.poles if not pole.imag and pole.real > SLOW]
    pole = min(slow, key=lambda one: abs(one - 1), default=None)
    if pole is None:
        if not model.is_stable:
            yield Advice(UNSTABLE, "--constraint stable:0.99")
        return
    try:
        nearest = fit.uncertainty.of(lambda model: model.poles[np.argmin(np.abs(model.poles - pole))].real)
        reach, words = 2 * float(nearest.error), f"{pole:.6g} ± {2 * float(nearest.error):.2g}"
    except (OptidError, np.linalg.LinAlgError):  # no intervals: what grows by less than e over the record
        reach, words = 1 / max(e.n_samples for e in fit.data.experiments), f"{pole:.6g}"
    if abs(pole - 1) <= reach and model.integrates_within(reach):
        word = "--constraint integrator" if hasattr(model, "nk") else "--formulation oe.exact --constraint integrator"
        word = word if model.l == 1 else f"data.select(outputs=...) and {word} for each output"
        yield Advice(f"the record does not tell the pole {words} from 1: the plant may integrate, its output ramp "
                     "while the inputs are held", word)
    elif not model.is_stable:
        yield Advice(UNSTABLE, "--constraint stable:0.99")


def _try(fit: Any, **changes: Any) -> Any:
    """Fit again with changes; None where that fails."""
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        try:
            return fit.refit(**changes)
        except (OptidError, np.linalg.LinAlgError, ValueError):
            return None


def _score(model: Any, data: Data) -> float:
    """Return the simulation fit in %, a mean over the outputs; minus infinity where there is none."""
    value = float(np.mean(prediction_fit(model, data, SIMULATION)))
    return value if np.isfinite(value) else -np.inf


def _more(values: Any, more: int) -> Any:
    return [int(v) + more for v in values] if isinstance(values, list | tuple) else int(values) + more


def _words(values: Any) -> str:
    return " ".join(map(str, values)) if isinstance(values, list | tuple) else str(values)
