"""Is the verdict on a model true? Models of right and wrong structures of simulated plants, judged by their responses.

Every record of `KINDS` is fitted with the structure of its plant, and with wrong ones in turns: another order, the dead
time left out, the static function left out, too many parameters, the channels swapped, another input, the first samples
alone, and in a loop direct feedthrough and methods for open loops. The error of a model is that of its step responses
(`simulated_plants.response_error`). `judge(kind, seed)` returns a row a model; `record_tests.py` prints them.
"""

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any
from zlib import crc32

import numpy as np
from plant_records import CLOSED, REGULATED, PlantRecord, excite, record
from simulated_plants import Plant, response_error

import optid
from optid.errors import OptidError

KINDS = (
    "open: one step", "open: bump", "open: staircase", "open: PRBS", "open: several steps", "open: second order",
    "open: third order", "open: fourth order", "open: resonant", "open: inverse response", "open: integrating",
    "open: dead time 100", "open: saturation", "open: any curve", "open: Wiener", "open: nonlinear feedback",
    "open: gain drift", "open: quantised", "open: sensor drift", "open: slow set-points", "open: sine",
    "moved: PI, steps", "moved: PID, random", "regulated: PI", "idle: staircase, transient", "idle: PRBS, AR",
    "two inputs: staircase", "bad: swapped")
RIGHT, WRONG = 0.05, 0.1  # errors of the response below which a model is right, and above which it is wrong
WRONG_FITS = 2  # of the wrong structures a record is fitted with
LEVELS = 12  # of an input, from which on a static function is fitted
WORDS = ("good", "fair", "poor", "useless")


@dataclass(frozen=True)
class Row:
    """A model and its verdict.

    Attributes:
        kind, seed: of the record.
        structure: what was fitted.
        word: of the verdict; "" where there is no model.
        error: of the response.
        score: fit that the verdict rests on.
        parts: name, value, whether it passes and whether it counts, for every part of the verdict.
        reason: why there is no model.
        seconds: CPU time of the verdict.
        able: whether the structure can be right: linear or Hammerstein plants, of which the record can tell something.
    """

    kind: str
    seed: int
    structure: str
    word: str
    error: float
    score: float
    parts: tuple[tuple[str, str, bool, bool], ...]
    reason: str
    seconds: float
    able: bool

    @property
    def is_false(self) -> bool:
        """Whether a wrong model is called good or fair."""
        return self.word in ("good", "fair") and self.error > WRONG

    @property
    def is_missed(self) -> bool:
        """Whether a model with the right response is called poor or useless."""
        return self.word in ("poor", "useless") and self.error < RIGHT

    @property
    def is_right(self) -> bool:
        """Whether structure and response are right."""
        return self.able and self.structure.startswith("right") and self.error < RIGHT


def judge(kind: str, seed: int) -> list[Row]:
    """Fit a record of a kind with right and wrong structures, and judge every model."""
    one, rows = record(kind, seed), []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for structure, data, formulation, arguments in structures(one):
            clock, word, score, parts, model, reason = time.process_time(), "", np.nan, (), None, ""
            try:
                found = optid.fit(data, formulation, prove=False, **arguments)
                model, clock = found.model, time.process_time()
                told = found.verdict
                word, score = told.word, told.score
                parts = tuple((p.name, p.value, p.passed, p.counts) for p in told.parts)
            except OptidError as refusal:
                reason = f"{type(refusal).__name__}: {refusal}"
            seconds = time.process_time() - clock
            fair = structure not in ("swapped", "another input") and model is not None
            (e,) = (data if fair else one.data).experiments  # the verdict holds within the range of its record
            plants = tuple(p if p is None or p.drift is None else replace(
                p, drift=p.drift[-one.data.n_samples :][: e.n_samples]) for p in one.plants)
            error = response_error(model, plants, e.u, e.y) if fair else np.inf
            able = one.loop != REGULATED and all(p is None or p.is_hammerstein for p in one.plants)
            rows.append(Row(kind, seed, structure, word, error, score, parts, reason, seconds, able))
    return rows


Structure = tuple[str, optid.Data, str, dict[str, Any]]


def structures(one: PlantRecord) -> Iterator[Structure]:
    """Yield what a record is fitted with: name, record, formulation and its arguments."""
    data, plant = one.data, next((p for p in one.plants if p is not None), None)
    rng = np.random.default_rng([one.seed, crc32(one.kind.encode()), 1])
    if plant is not None:
        right = list(_right(one, plant))
        yield right[one.seed % len(right)]
    wrong = list(_wrong(one, plant, rng))
    for i in range(min(WRONG_FITS, len(wrong))):
        yield wrong[(one.seed * WRONG_FITS + i) % len(wrong)]
    if plant is None:
        yield "output errors", data, "oe.exact", {"na": 1, "nb": 1, "nk": 1}


def orders(plant: Plant) -> dict[str, int]:
    """Return na, nb and nk of a plant."""
    b, a = plant.linear.discrete
    size = np.abs(b) > 1e-9 * np.max(np.abs(b))
    return {"na": len(a) - 1, "nb": int(np.sum(size)), "nk": plant.linear.nk}


def _right(one: PlantRecord, plant: Plant) -> Iterator[Structure]:
    form = orders(plant)
    curved = not plant.is_linear and len(np.unique(one.data.experiments[0].u)) > LEVELS
    static, before = ({"basis": "triangular:6"}, "hammerstein_") if curved else ({}, "")
    more = {**form, "nb": [form["nb"], 1], "nk": [form["nk"], 1]} if len(one.plants) == 2 else form
    if one.loop in (CLOSED, REGULATED):
        yield "right, armax", one.data, "armax.exact", {**more, "nc": more["na"]}
        yield "right, bj", one.data, "bj.exact", {**more, "nc": 1, "nd": 1}
    else:
        yield "right, oe", one.data, f"{before}oe.exact", {**more, **static}
        yield "right, arx", one.data, f"{before}arx.exact" if before else "arx", {**more, **static}


def _wrong(one: PlantRecord, plant: Plant | None, rng: np.random.Generator) -> Iterator[Structure]:
    data, u = one.data, one.data.experiments[0].u
    y, n = one.data.experiments[0].y, one.data.n_samples
    form = orders(plant) if plant else {"na": 1, "nb": 1, "nk": 1}
    yield "too many, arx 8 8", data, "arx", {"na": 8, "nb": 8, "nk": 0}
    bent = {"na": 4, "nb": 8, "nk": 0, "basis": "triangular:8"}
    yield "too many, hammerstein 4 8", data, "hammerstein_arx.exact", bent
    yield "dead time left out", data, "oe.exact", {**form, "nk": 0}
    if form["na"] > 1:
        yield "first order", data, "oe.exact", {"na": 1, "nb": 1, "nk": form["nk"]}
    else:
        yield "two orders more", data, "oe.exact", {"na": 3, "nb": 3, "nk": form["nk"]}
    if plant and not plant.is_linear:
        yield "static function left out", data, "oe.exact", form
    if one.loop in (CLOSED, REGULATED):
        yield "feedthrough", data, "arx", {"na": 2, "nb": 3, "nk": 0}
        yield "output errors", data, "oe.exact", form
        yield "subspace", data, "hammerstein_ss.asivid", {"nx": 2, "basis": "linear"}
    if u.shape[1] == 1:
        yield "swapped", optid.Data(y, u, data.dt), "arx", {"na": 2, "nb": 2, "nk": 0}
        other = excite(rng, str(rng.choice(["staircase", "PRBS", "smooth", "several steps"])), n)
        yield "another input", optid.Data(other, y, data.dt), "oe.exact", {"na": 2, "nb": 2, "nk": 1}
        yield "another input", optid.Data(other, y, data.dt), "arx", {"na": 2, "nb": 2, "nk": 1}
    yield "first samples alone", data[: max(30, n // 6)], "oe.exact", form
    yield "first samples alone", data[: max(30, n // 6)], "arx", {"na": 4, "nb": 4, "nk": 1}


def table(rows: list[Row]) -> str:
    """Return the models by word and by error of the response."""
    edges = (-np.inf, RIGHT, WRONG, np.inf)
    lines = [f"{'':<10}{'below 5 %':>12}{'5 to 10 %':>12}{'above 10 %':>12}"]
    for word in (*WORDS, ""):
        counts = [sum(r.word == word and low <= r.error < high or (r.word == word and high == np.inf == r.error)
                      for r in rows) for low, high in zip(edges, edges[1:])]
        lines.append(f"{word or 'refused':<10}" + "".join(f"{count:>12}" for count in counts))
    return "\n".join(lines)
