"""Documents of results: sections of banners, facts, tables, charts and notes, for every renderer."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.data.description import first_findings
from optid.errors import OptidError
from optid.progress import log
from optid.show.wording import Table

Facts = list[tuple[str, str]]

CAUGHT: tuple[type[Exception], ...] = (Exception,)
"""Errors in a part of a document after which the others are still shown; the tests set none, which hides no defect."""

FAILED = "could not be computed"
"""Words of every note in place of a part that failed."""

TONES = {"good": "good", "fair": "plain", "poor": "fair", "useless": "bad"}
"""How a verdict on a model is coloured; green is left to models that are good."""


@dataclass(frozen=True)
class Banner:
    """A verdict in one word, with a sentence."""

    tone: str  # "good", "plain", "fair" or "bad"
    word: str  # the verdict
    sentence: str = ""  # what it means
    cards: tuple[tuple[str, str], ...] = ()  # (label, value) of the first glance


@dataclass(frozen=True)
class Axis:
    """An axis: its title with the unit, whether it is logarithmic, its ends where they are fixed, the bare unit.

    The axis of a record counts samples too: `start` is the place of sample 0, `step` the sampling time if there is
    one. Places are seconds since 1970 where they are `dates`.
    """

    title: str
    log: bool = False
    low: float | None = None
    high: float | None = None
    unit: str = ""
    dates: bool = False
    start: float | None = None
    step: float | None = None


@dataclass(frozen=True)
class Series:
    """One curve of a chart."""

    name: str  # of the legend; "" for none
    xs: Any  # (n,) places, ascending but for "line-only"
    ys: Any  # (n,) values, NaN where there are none; (n,) upper ends of an area
    # "curve", "line-only" (any order), "area", "stems", "diamonds", "dots", "poles", "bars" (heights 0 to 1), and of
    # figures, not of pages, "zeros"
    kind: str = "curve"
    colour: str = "c0"  # variable of the style sheet
    lows: Any = None  # (n,) lower ends of an area
    dash: str = ""  # SVG dashes
    width: float = 1.6  # of the line, in pixels
    aside: bool = False  # whether the extent of the chart does not count it
    held: bool = False  # whether a curve keeps every value until the next


@dataclass(frozen=True)
class Chart:
    """A figure: axes, curves, and the name of the group whose x axes move together."""

    title: str
    caption: str
    x: Axis
    y: Axis
    series: Sequence[Series]
    group: str = ""
    equal: bool = False
    height: int | None = None


@dataclass(frozen=True)
class Notes:
    """Remarks, each with a mark beside it."""

    sentences: Sequence[str]


@dataclass(frozen=True)
class Findings:
    """What reading a record derived, assumed or repaired."""

    sentences: Sequence[str]

    @property
    def shown(self) -> list[str]:
        """The first of them, and how many there are beside."""
        return first_findings(self.sentences)


@dataclass(frozen=True)
class Code:
    """Text of fixed width: equations, calls. `equation` breaks long lines before a sign."""

    text: str
    equation: bool = False


@dataclass(frozen=True)
class Fold:
    """Parts that open on a click."""

    title: str
    parts: Sequence[Any]


@dataclass(frozen=True)
class Pair:
    """Tables side by side where there is room, or notes in place of those that failed."""

    tables: Sequence[Table | Notes]


@dataclass(frozen=True)
class FactColumns:
    """Facts in two columns where there is room."""

    left: Facts
    right: Facts


@dataclass(frozen=True)
class Charts:
    """Charts side by side where there is room, or one below the other in the whole width; notes for those failed."""

    charts: Sequence[Chart | Notes]
    wide: bool = False


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    text: str


@dataclass(frozen=True)
class Section:
    """A part of a document."""

    id: str  # anchor on a page
    title: str  # heading, "" for a banner, which has its own
    # banners, facts, tables, charts, notes, code, folds; a function that returns them where that takes time
    parts: Sequence[Any] | Callable[[], Sequence[Any]]
    page_only: bool = False  # whether printed text and notebooks leave it out

    def content(self) -> list[Any]:
        """Return the parts, or a note with the reason why they could not be computed."""
        return attempt(f"Section {(self.title or self.id)!r}", self.parts) if callable(self.parts) else [*self.parts]


@dataclass(frozen=True)
class Document:
    """Everything about a result, most important first."""

    title: str
    lead: str
    sections: Sequence[Section]


def attempt(what: str, build: Callable[[], Iterable[Any]]) -> list[Any]:
    """Return the parts that a function builds, or a note with the reason why they could not be computed."""
    try:
        return list(build())
    except CAUGHT as error:
        return [Notes([failure(what, error)])]


def failure(what: str, error: Exception) -> str:
    """Return the sentence in place of a part that failed; the log "optid" has the traceback."""
    log.debug("%s %s", what, FAILED, exc_info=error)
    reason = str(error).rstrip(".") if isinstance(error, OptidError) else (
        f"{type(error).__name__}: {error}; this is a defect of optid")
    return f"{what} {FAILED}: {reason}."


def extremes(values: Array, bins: int) -> NDArray[np.intp]:
    """Return the places of the smallest and the largest of each of so many stretches of values (N,), and of gaps."""
    values, width = np.asarray(values, dtype=float), -(-values.size // bins)
    stretches = np.pad(values, (0, -values.size % width), constant_values=np.nan).reshape(-1, width)
    missing, first = ~np.isfinite(stretches), np.arange(0, values.size, width)
    places = np.concatenate([first + np.argmin(np.where(missing, np.inf, stretches), axis=1),
                             first + np.argmax(np.where(missing, -np.inf, stretches), axis=1),
                             (first + np.argmax(missing, axis=1))[missing.any(axis=1)]])
    return np.unique(places[places < values.size])


def decibels(magnitude: Array) -> Array:
    """Return magnitudes in dB."""
    return 20 * np.log10(np.maximum(magnitude, 1e-12))
