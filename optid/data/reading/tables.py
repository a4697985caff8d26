"""Sources of records: named columns, loaded whole, or read in blocks and parts."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from optid.data.reading.format import Format
from optid.data.reading.parts import Part


@dataclass(frozen=True)
class RawTable:
    """A source whose columns can be loaded by name."""

    label: str  # name of the source, for messages
    names: list[str]  # names of its columns or variables
    # function of columns, and of those among them that may be texts or dates, returning {name: array}: numeric columns
    # are (N,) or (N, channels) of a real type, texts (N,) objects
    load: Callable[[Sequence[str], Mapping[str, str]], dict[str, Any]]
    how: Format = Format()  # how it is written: what the user said, completed by what the source says
    index: str | None = None  # name of a time index besides the columns
    dates: tuple[str, ...] = ()  # columns of dates
    units: Mapping[str, str] = field(default_factory=dict)  # units by column, where the source has them
    step: float | None = None  # sampling time that stands beside the samples
    hints: Mapping[str, str] = field(default_factory=dict)  # why columns not named as a clock may be it
    advice: str = ""  # what a refusal proposes to type
    findings: tuple[str, ...] = ()
    # function of the columns of inputs and outputs, and of `time` as of `optid.data.readers.read`, where they decide
    # which experiments there are, and with which clock: returns a table for each
    split: Callable[[Sequence[str], Any], "list[RawTable]"] | None = None
    inputs: Mapping[str, str] | None = None  # {channel: column} of the inputs, where the source says it
    outputs: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Source:
    """A source of one experiment that need not fit into memory."""

    names: Sequence[str]  # names of its columns
    n_samples: int | None  # number of samples, None if only a pass gives it
    whole: Part | None  # all of it; None where it exists in parts only
    # function of the columns to read, returning the independent parts in the order of time
    parts: Callable[[Sequence[str]], Iterable[Part]]
    label: str  # name of the source, for messages
    how: Format = Format()  # how it is written
    dates: tuple[str, ...] = ()  # columns of dates
    units: Mapping[str, str] = field(default_factory=dict)  # units by column, where the source has them
    findings: tuple[str, ...] = ()
