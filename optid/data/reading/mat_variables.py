"""The variables in the tree of a MAT file, with the forms that Simulink and the System Identification Toolbox save."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optid.data.reading.clock import is_rate_name, is_step_name, is_time_name
from optid.data.reading.mat_tree import Elements, Node, Numbers, Refused

SECONDS_PER_UNIT = {"nanoseconds": 1e-9, "microseconds": 1e-6, "milliseconds": 1e-3, "seconds": 1.0, "minutes": 60.0,
                    "hours": 3600.0, "days": 86400.0, "weeks": 604800.0}
SIDES = {"u": ("InputData", "InputName", "InputUnit"), "y": ("OutputData", "OutputName", "OutputUnit")}


@dataclass(frozen=True)
class Variable:
    """A leaf of the tree."""

    path: tuple[str, ...]  # names of fields, without indices
    name: str  # as in MATLAB, with indices
    index: tuple[int, ...]  # places in the arrays of structures and cells on its path, from 1
    node: Numbers | Refused | str
    is_time: bool = False  # whether it holds the time of the variables beside it
    side: str = ""  # "u" or "y" for a named channel of `get(iddata)`
    channel: str = ""  # its name
    unit: str = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """(N,) or (N, channels); () for what holds no numbers."""
        return self.node.shape if isinstance(self.node, Numbers) else ()

    @property
    def size(self) -> int:
        """Number of values; zero for what holds no numbers."""
        return int(np.prod(self.shape)) if self.shape else 0


def is_time_vector(name: str) -> bool:
    """Whether a vector is named as a time."""
    return is_time_name(name) or name.lower() in ("tout", "samplinginstants")


def is_scalar_clock(name: str) -> bool:
    """Whether a number is named as a sampling time or rate."""
    return is_step_name(name) or is_rate_name(name)


def list_variables(tree: dict[str, Node]) -> list[Variable]:
    """Return all variables; channels of a known form by name besides, and columns of a single matrix by position."""
    variables = list(_leaves(tree, (), "", ()))
    for form in (_structures_with_time, _iddata, _times_in_seconds, _single_matrix):
        variables = form(variables)
    return variables


def _leaves(node: Node, path: tuple[str, ...], name: str, index: tuple[int, ...]) -> Iterator[Variable]:
    if isinstance(node, dict):
        for key, child in node.items():
            yield from _leaves(child, (*path, key), f"{name}.{key}" if name else key, index)
    elif isinstance(node, Elements):
        if _holds_scalars(node) and not is_scalar_clock(path[-1]):
            yield from _scalar_elements(node, path, name, index)
            return
        for k, child in enumerate(node.items, 1):
            yield from _leaves(child, path, f"{name}{node.brackets[0]}{k}{node.brackets[1]}", (*index, k))
    else:
        is_time = isinstance(node, Numbers) and is_time_vector(path[-1]) and len(node.shape) == 1 < node.shape[0]
        yield Variable(path, name, index, node, is_time)


def _holds_scalars(elements: Elements) -> bool:
    """Whether there is a number in it, and nothing but single numbers, text and empty elements."""
    shapes = [shape for item in elements.items for shape in _shapes(item)]
    return (1,) in shapes and all(shape in ((1,), ()) for shape in shapes)


def _shapes(node: Node) -> Iterator[tuple[int, ...] | None]:
    """Yield the shapes of numbers, () for text and what is empty, None for all that cannot be read."""
    if isinstance(node, dict | Elements):
        for child in node.values() if isinstance(node, dict) else node.items:
            yield from _shapes(child)
    else:
        yield node.shape if isinstance(node, Numbers) else () if isinstance(node, str) or node.is_empty else None


def _scalar_elements(node: Elements, path: tuple[str, ...], name: str, index: tuple[int, ...]) -> Iterator[Variable]:
    """Refuse numbers that are spread over elements, which are one signal and no experiments."""
    count = len(node.items)
    if node.brackets == "{}":
        yield Variable(path, name, index, Refused(f"is a cell array of {count} scalars", "{0} = cell2mat({0})"))
        return
    for key in dict.fromkeys(key for item in node.items if isinstance(item, dict) for key in item):
        if any(isinstance(item, dict) and isinstance(item.get(key), Numbers) for item in node.items):
            reason = Refused(f"is spread over {count} structures, one number in each", f"{key} = [{name}.{key}]'")
            yield Variable((*path, key), f"{name}.{key}", index, reason)


# -- known forms


def _structures_with_time(variables: list[Variable]) -> list[Variable]:
    """Name the signals of Simulink's "Structure with time" by their labels, a single one like the structure."""
    groups = by_path(variables)
    for path in [path for path in groups if path[-2:] == ("signals", "values")]:
        group = path[:-2]
        values, labels = groups[path], {v.index: v.node for v in groups.get((*path[:-1], "label"), [])}
        depth = len(groups[(*group, "time")][0].index) if (*group, "time") in groups else len(values[0].index)
        is_array = any(len(v.index) > depth for v in values)
        if (*group, "time") not in groups or not (group or is_array):
            continue
        names = [(v.index[:depth], labels.get(v.index, "") if is_array else "") for v in values]
        taken = {p[len(group)] for p in groups if p[: len(group)] == group and len(p) > len(group)}
        new = {}
        for v, name in zip(values, names):
            label, number = str(name[1]), f"signals{v.index[-1]}" if is_array else ""
            key = label if _is_name(label) and names.count(name) == 1 and label not in taken else number
            head = v.name[: v.name.rindex("signals")]
            new[id(v)] = replace(v, path=(*group, key) if key else group, name=head + key if key else head[:-1],
                                 index=v.index[:depth])
        gone = {id(v) for p, found in groups.items() if p[: len(path) - 1] == path[:-1] for v in found}
        variables = [new.get(id(v), v) for v in variables if id(v) in new or id(v) not in gone]
    return variables


def _iddata(variables: list[Variable]) -> list[Variable]:
    """Name the channels of what `get(iddata)` gives, before the arrays that hold them."""
    groups = by_path(variables)
    channels: list[Variable] = []
    units: dict[int, str] = {}
    for group in [path[:-1] for path in groups if path[-1] == "OutputData" and (*path[:-1], "InputData") in groups]:
        if any(text.lower() == "frequency" for text in _texts(groups, (*group, "Domain"))):
            refusal = Refused("is in the frequency domain; optid reads records over time")
            gone = {id(v) for data, *_ in SIDES.values() for v in groups[(*group, data)]}
            variables = [replace(v, node=refusal) if id(v) in gone else v for v in variables]
            continue
        for side, (data, name, unit) in SIDES.items():
            names, there = _texts(groups, (*group, name)), {p[-1] for p in groups if p[:-1] == group}
            channel_units = _texts(groups, (*group, unit))
            for v in groups[(*group, data)]:
                width = v.shape[1] if len(v.shape) > 1 else min(len(v.shape), 1)
                if width == 1 and len(channel_units) == 1:
                    units[id(v)] = channel_units[0]
                for k, channel in enumerate(names if len(names) == width and len(set(names)) == width else []):
                    # the names u and y stand for all channels
                    is_free = _is_name(channel) and channel not in there and (channel not in SIDES or width == 1)
                    key = channel if is_free else f"{data}{k + 1}"
                    head, _, end = v.name.rpartition(data)
                    channels.append(Variable((*group, key), head + key + end, v.index, _column(v.node, k), False, side,
                                             channel or key, (*channel_units, *[""] * width)[k]))
    return channels + [replace(v, unit=units[id(v)]) if id(v) in units else v for v in variables]


def _times_in_seconds(variables: list[Variable]) -> list[Variable]:
    """Convert times and sampling times to seconds where a `TimeUnit` is beside them."""
    groups = by_path(variables)

    def convert(v: Variable) -> Variable:
        unit = next(iter(_texts(groups, (*v.path[:-1], "TimeUnit"))), "").lower() or "seconds"
        if not isinstance(v.node, Numbers) or not (v.is_time or is_step_name(v.path[-1])) or unit == "seconds":
            return v
        if unit not in SECONDS_PER_UNIT:
            return replace(v, node=Refused(f"is in {unit[:40]!r}; known TimeUnit: {', '.join(SECONDS_PER_UNIT)}"))
        load = v.node.load
        return replace(v, node=Numbers(v.node.shape, lambda: load() * SECONDS_PER_UNIT[unit]))

    return [convert(v) for v in variables]


def _single_matrix(variables: list[Variable]) -> list[Variable]:
    """Name the columns of a single matrix by position, a first one that increases as their time.

    What the block "To File" writes has samples as columns, with time in the first row.
    """
    signals = [v for v in variables if v.size > 1]
    if len(signals) != 1 or len(signals[0].shape) != 2:
        return variables
    node = signals[0].node
    assert isinstance(node, Numbers)
    rows, columns = node.shape
    by_row = rows < columns
    if by_row:
        load = node.load
        node = Numbers((columns, rows), lambda: load().T)
    is_clock = _is_increasing(node.load()[:, 0])
    if by_row and not is_clock:
        return variables
    parts = [Variable((*signals[0].path[:-1], str(k)), str(k), (), _column(node, k), is_time=is_clock and k == 0)
             for k in range(node.shape[1])]
    return parts + variables


def _is_increasing(stamps: np.ndarray) -> bool:
    steps = np.diff(stamps.astype(float))
    return bool(np.all(steps >= 0) and np.median(steps) > 0)


def _column(node: Node, k: int) -> Numbers | Refused | str:
    if not isinstance(node, Numbers):
        return node if isinstance(node, Refused) else ""
    load = node.load
    return node if len(node.shape) == 1 else Numbers(node.shape[:1], lambda: load()[:, k])


def by_path(variables: list[Variable]) -> dict[tuple[str, ...], list[Variable]]:
    """Return the variables of each path."""
    groups: dict[tuple[str, ...], list[Variable]] = {}
    for v in variables:
        groups.setdefault(v.path, []).append(v)
    return groups


def _texts(groups: dict[tuple[str, ...], list[Variable]], path: tuple[str, ...]) -> list[str]:
    return [v.node.strip() for v in groups.get(path, []) if isinstance(v.node, str)]


def _is_name(text: str) -> bool:
    return 0 < len(text) <= 63 and text.isprintable()
