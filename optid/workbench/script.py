"""The Python that repeats a fit of the workbench: running it gives the same numbers."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from optid.data.readers import Format
from optid.registry import CONSTRAINTS, entry_point
from optid.workbench.request import BAND, PASSES, ChosenConstraint, Request


def script(request: Request, source: str, whole: bool = False) -> str:
    """Write a fit as a script; `source` is the expression that reads the record, of which `whole` takes all samples."""
    homes: dict[str, set[str]] = {}
    for c in request.constraints:
        point = entry_point(CONSTRAINTS, c.word)
        homes.setdefault(point.module, set()).add(point.attr)
    imports = [f"from {module} import {', '.join(sorted(names))}" for module, names in sorted(homes.items())]
    window = "" if whole else f".window({request.window[0]}, {request.window[1]})"
    changes = ".detrend(order=1).raw()" * request.detrended
    changes += "" if request.dt is None else f".resample({request.dt!r})"
    known = [_call(c) for c in request.constraints if c.word != BAND]
    bands = [c for c in request.constraints if c.word == BAND]
    repeated = bool(bands and request.arguments.get("na", 0))
    if not repeated:
        known += [_call(c) for c in bands]
    arguments = "".join(f", {key}={value!r}" for key, value in request.arguments.items())
    fit = f"optid.fit(data, {request.formulation!r}{arguments}, constraints=%s)"
    lines = [
        '"""A fit, written by the optid workbench."""', "", "import optid", *imports, "",
        f"data = {source}",
        f"data = data.select(inputs={list(request.inputs)!r}, outputs={list(request.outputs)!r}){window}{changes}",
        "constraints = [", *(f"    {one}," for one in known), "]",
        f"fit = {fit % 'constraints'}",
    ]
    if repeated:
        around = ", ".join(_call(c, ", around=fit.model") for c in bands)
        lines += [f"for _ in range({PASSES}):  # the band is linearised at the previous model",
                  f"    fit = {fit % f'[*constraints, {around}]'}"]
    return "\n".join([*lines, "print(fit)", ""])


def reading(files: list[str], how: Mapping[str, Any]) -> str:
    """Write the call that reads files, without default options."""
    usual = {field.name: field.default for field in fields(Format)} | {"missing": ()}
    given = {key: value for key, value in how.items() if value is not None and value != usual.get(key)}
    options = "".join(f", {key}={value!r}" for key, value in given.items())
    return f"optid.read({files if len(files) > 1 else files[0]!r}{options})"


def _call(c: ChosenConstraint, more: str = "") -> str:
    arguments = ", ".join(f"{key}={value!r}" for key, value in c.arguments.items())
    return f"{entry_point(CONSTRAINTS, c.word).attr}({arguments}{more}).with_name({c.name!r})"
