"""The signals, experiments and clocks of a MAT file by name."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from optid.data.reading.clock import is_rate_name
from optid.data.reading.mat_tree import Node, Numbers, Refused, open_tree
from optid.data.reading.mat_variables import SIDES, Variable, by_path, is_scalar_clock, is_time_vector, list_variables
from optid.errors import DataError, nearest

VECTOR, SCALAR, HIDDEN, NO_CLOCK = range(4)  # kinds of clocks, the best first; a hidden one cannot be read
H5PY = 'pip install "optid[mat]"'
STEP_TOLERANCE = 0.01  # largest relative difference of two sampling times in one structure

FieldPath = tuple[str, ...]
Found = list[Variable]  # variables of one path, one for each element of the arrays on it


@dataclass(frozen=True)
class MatContents:
    """Variables of a MAT file by name.

    A variable has its path in MATLAB as name, "run.u", and "run(2).u" or "u{2}" for one element of an array of
    structures or of a cell array. The variables of the structure that holds the record have short names besides, "u".
    Further names: the label of a signal in a "Structure with time" of Simulink, u and y for the data in `get(iddata)`
    and its channel names, and positions "0", "1", ... for the columns of a single matrix, or its rows if they begin
    with a time as Simulink's "To File" writes them.
    """

    # {name: array (N,) or (N, channels), or None where no names were asked for}, one for each experiment of the names:
    # "run.u" and "run.y" have one for each element of `run`, "run(2).u" and "run(2).y" have one
    experiments: tuple[dict[str, Any], ...]
    # {name: name of the clock beside it}: a time vector, or a scalar such as Ts, dt or fs
    clocks: dict[str, str] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)  # {name of such a scalar: sampling time in seconds}
    counts: dict[str, int] = field(default_factory=dict)  # {name: number of its experiments}
    refused: dict[str, str] = field(default_factory=dict)  # {name: why it cannot be read, and what to do}
    units: dict[str, str] = field(default_factory=dict)  # {name: unit} where `get(iddata)` says it
    inputs: dict[str, str] = field(default_factory=dict)  # {channel name: name} of the inputs in `get(iddata)`
    outputs: dict[str, str] = field(default_factory=dict)  # and of its outputs


def read_contents(tree: dict[str, Node], names: Sequence[str] | None) -> MatContents:
    """Return the variables of these names, by default only which there are; `DataError`: no such name."""
    record = _Record(list_variables(tree))
    return record.list_names() if names is None else record.load(names)


def file_contents(path: Path, names: Sequence[str] | None) -> MatContents:
    """Return the variables of these names, by default only which there are; errors as of `mat_contents`.

    This runs in the child process.
    """
    try:
        with open_tree(path) as tree:
            return read_contents(tree, names)
    except DataError as error:
        raise DataError(f"{path.name}: {error}") from None
    except Exception as error:  # whatever a library raises on a damaged file
        if isinstance(error, ImportError) and "h5py" in str(error):
            raise DataError(f"{path.name} is a MAT file of version 7.3, which needs h5py: {H5PY}") from None
        text = str(error) or type(error).__name__
        raise DataError(f"{path.name} is damaged, or not a MAT file: {text}") from None


class _Record:
    """Variables by name, and the structure among them that holds the record."""

    def __init__(self, variables: list[Variable]) -> None:
        groups = by_path(variables)
        self.clocks: dict[FieldPath, list[Found]] = {}  # clocks in each structure, the best first
        for found in sorted(groups.values(), key=_clock_rank):
            if _clock_rank(found) < NO_CLOCK:
                self.clocks.setdefault(found[0].path[:-1], []).append(found)
        shown = {path: found for path, found in groups.items()
                 if _clock_rank(found) < NO_CLOCK or any(not isinstance(v.node, str) for v in found)}
        self.home = _find_home(shown)
        self.names = _short_names(shown, self.home) | {".".join(path): found for path, found in shown.items()}
        self.elements = {v.name: v for v in variables if v.index and v.path in shown and v.name not in self.names
                         and not isinstance(v.node, str)}

    def list_names(self) -> MatContents:
        """Return all but the arrays."""
        names = [*self.names, *self.elements]
        clocks = self._clocks(names)
        refused = self._refused(names)
        steps = self._steps(names, refused)
        channels = {name: v for name, (v, *_) in self.names.items() if v.path[:-1] == self.home}
        sides = [{v.channel: name for name, v in channels.items() if v.side == side} for side in SIDES]
        counts = {name: len({v.index for v in self._find(name)}) for name in names}
        units = {name: v.unit for name in names if (v := self._find(name)[0]).unit}
        return MatContents((dict.fromkeys(names),), clocks, steps, counts, refused, units, *sides)

    def load(self, names: Sequence[str]) -> MatContents:
        """Return the arrays of some names."""
        wanted = {name: self._find(name) for name in names}
        refused = self._refused(names)
        steps = self._steps(names, refused)
        places = {v.index for found in wanted.values() for v in found}
        places -= {place[:k] for place in places for k in range(len(place))}
        experiments: list[dict[str, Any]] = []
        for place in sorted(places):
            experiments.append({})
            for name, found in wanted.items():
                here = [v for v in found if v.index == place[: len(v.index)]]
                if not here:
                    raise DataError(f"experiment {', '.join(map(str, place))} has no {name!r}, another one has.")
                node = here[0].node
                if isinstance(node, Numbers) and name not in refused:
                    experiments[-1][name] = node.load()
        return MatContents(tuple(experiments), self._clocks(names), steps, refused=refused)

    def _find(self, name: str) -> Found:
        if name in self.elements:
            return [replace(self.elements[name], index=())]
        if name not in self.names:
            raise DataError(f"there is no variable {name!r}. {nearest(name, [*self.names, *self.elements])}")
        return self.names[name]

    def _refused(self, names: Sequence[str]) -> dict[str, str]:
        """Return why some names cannot be read, {} where they can be."""
        reasons: dict[str, str] = {}
        for name in names:
            for v in self._find(name):
                if isinstance(v.node, str):
                    reasons.setdefault(name, "is text; save it as numbers, a time in seconds")
                elif isinstance(v.node, Refused):
                    line = f". In MATLAB: {v.node.line.replace('{0}', v.name)}" if v.node.line else ""
                    reasons.setdefault(name, v.node.reason + line)
        return reasons

    # -- clocks

    def _clocks(self, names: Sequence[str]) -> dict[str, str]:
        """Return the clock beside each variable, in its structure or in the nearest one around it."""
        clocks = {}
        for name in names:
            path, index = self._find(name)[0].path, self.elements[name].index if name in self.elements else None
            beside = [found for depth in range(len(path), -1, -1) for found in self.clocks.get(path[:depth], [])
                      if found[0].path != path]
            if beside:
                same = [v for v in beside[0] if index is not None and v.index and v.index == index[: len(v.index)]]
                clocks[name] = same[0].name if same else ".".join(beside[0][0].path)
        return clocks

    def _steps(self, names: Iterable[str], refused: dict[str, str]) -> dict[str, float]:
        """Return the sampling times that scalars among some names give; adds why one gives none to `refused`."""
        steps = {}
        for name in {name: None for name in names if name not in refused}:
            found = self._find(name)
            step = _step(found) if _clock_rank(found) == SCALAR else None
            trouble = step if isinstance(step, str) else "" if step is None else self._disagreement(found[0], step)
            if trouble:
                refused[name] = trouble
            elif isinstance(step, float):
                steps[name] = step
        return steps

    def _disagreement(self, clock: Variable, step: float) -> str:
        """Return how a clock, whose step is given, disagrees with a sampling time beside it, empty if with none."""
        for found in self.clocks.get(clock.path[:-1], []):
            other = _step(found) if _clock_rank(found) == SCALAR and found[0].path != clock.path else None
            if isinstance(other, float) and not abs(step - other) <= STEP_TOLERANCE * other:
                return f"has the step {step:g}, but {'.'.join(found[0].path)} says {other:g} s. Pass dt"
        return ""


def _find_home(shown: Mapping[FieldPath, Found]) -> FieldPath | None:
    """Return the structure that holds the record; None if several might.

    It is the only one with inputs u or u1, ... and outputs y or y1, ..., the top level before all others; if none has
    both, the only one with signals of the largest length.
    """
    letters: dict[FieldPath, set[str]] = {}
    for path, found in shown.items():
        is_signal = any(v.size > 1 or isinstance(v.node, Refused) for v in found)
        if is_signal and re.fullmatch(r"[uy][0-9]*|InputData|OutputData", path[-1]):
            letters.setdefault(path[:-1], set()).add({"I": "u", "O": "y"}.get(path[-1][0], path[-1][0]))
    homes = [group for group, found in letters.items() if len(found) == 2]
    if not homes:
        lengths = {path: max(v.shape[0] if v.shape else 0 for v in found) for path, found in shown.items()}
        longest = max(lengths.values(), default=0)
        homes = list({path[:-1]: None for path, length in lengths.items() if length == longest > 1})
    return () if () in homes else homes[0] if len(homes) == 1 else None


def _short_names(shown: Mapping[FieldPath, Found], home: FieldPath | None) -> dict[str, Found]:
    """Return the variables in the structure that holds the record; none where the top level has the same names."""
    if home is None:
        return {}
    short = {".".join(path[len(home):]): found for path, found in shown.items() if path[: len(home)] == home}
    clashes = {name for name in short if home and (name,) in shown}
    if any(not (is_time_vector(name) or is_scalar_clock(name)) for name in clashes):
        return {}
    data = {side: shown[*home, names[0]] for side, names in SIDES.items() if (*home, names[0]) in shown}
    data = data if len(data) == len(SIDES) else {}
    return {**data, **{name: found for name, found in short.items() if name not in clashes}, **data}


def _clock_rank(found: Found) -> int:
    """Return what kind of clock a variable can be."""
    first = found[0]
    hidden = isinstance(first.node, Refused) and not first.node.is_empty
    if first.is_time:
        return VECTOR
    if is_scalar_clock(first.path[-1]) and (first.size == 1 or hidden):
        return SCALAR
    several = isinstance(first.node, str) and (len(found) > 1 or "\n" in first.node)
    return HIDDEN if is_time_vector(first.path[-1]) and (hidden or several) else NO_CLOCK


def _step(found: Found) -> float | str:
    """Return the sampling time in seconds that a scalar clock gives, or why it gives none."""
    values = [float(v.node.load()[0]) for v in found if isinstance(v.node, Numbers) and v.size == 1]
    if len(values) < len(found):
        return "is not one number in every experiment"
    if bad := [value for value in values if not 0 < value < np.inf]:
        return f"is {bad[0]:g}, which is no sampling time or rate. Pass dt"
    if max(values) > min(values) * (1 + 1e-9):
        return f"differs between the experiments ({min(values):g} to {max(values):g}). Read them one by one"
    return 1 / values[0] if is_rate_name(found[0].path[-1]) else values[0]
