"""Parts that every HTML page has: the template, figures that stand inside it, and what it was made with."""

import base64
import hashlib
import json
import platform
import re
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from optid import __version__
from optid.show.sections import Chart, Document, Series, extremes

SCRIPTS = ("plot.js", "parts.js", "charts.js")

SINGLE = 1e-30, 1e38
"""Sizes of curves that a page carries in single precision."""

MOST = 20_000
"""Samples of a curve that a page carries; of a longer one the extremes of half as many stretches."""


def write(document: Document, path: str | Path) -> Path:
    """Write a document as an HTML page that opens offline and makes no request; an existing file is replaced."""
    path = Path(path)
    path.write_text(render(document), encoding="utf-8")
    return path


def render(document: Document) -> str:
    """Return the page that `write` writes."""
    shown: list[dict[str, Any]] = []

    def place(chart: Chart) -> int:
        shown.append(encode_chart(chart))
        return len(shown) - 1

    sections = [(s, s.content()) for s in document.sections]
    names = {"trust": "Verdict", "optimum": "Solution"}
    return template("document.html.j2").render(
        version=__version__, title=document.title, lead=document.lead, parts=sections, place=place,
        breakable=_breakable, charts=lambda: embed_json(shown), **scripts(*SCRIPTS),
        sections=[(s.id, s.title or names.get(s.id, s.id)) for s, _ in sections])


def _breakable(equation: str) -> str:
    """Leave line breaks to the places before a sign."""
    return re.sub(r" (?![+-] )", "\N{NO-BREAK SPACE}", equation)


def encode_chart(chart: Chart, most: int = MOST) -> dict[str, Any]:
    """Return a chart as JSON types for the script of the page, its curves of at most so many samples."""
    axes = {name: {key: value for key, value in asdict(axis).items()
                   if value is not None and value is not False and value != ""
                   and (isinstance(value, str) or np.isfinite(value))}
            for name, axis in (("x", chart.x), ("y", chart.y))}
    cursor = all(one.kind in ("curve", "area", "bars") for one in chart.series)
    return {"title": chart.title, "caption": chart.caption, "group": chart.group, "equal": chart.equal,
            "height": chart.height, "cursor": cursor, **axes, "series": [_series(one, most) for one in chart.series]}


def _series(one: Series, most: int) -> dict[str, Any]:
    xs, ys, lows = (None if v is None else np.asarray(v, dtype=float) for v in (one.xs, one.ys, one.lows))
    assert xs is not None and ys is not None
    if ys.size > most:
        kept = extremes(ys, most // 2)
        xs, ys, lows = xs[kept], ys[kept], None if lows is None else lows[kept]
    coded = {"name": one.name, "kind": one.kind, "colour": f"var(--{one.colour})", "dash": one.dash,
             "width": one.width, "aside": one.aside, "held": one.held, "xs": _numbers(xs, "<f8"),
             "ys": _numbers(ys, "<f4")}
    return coded if lows is None else {**coded, "lows": _numbers(lows, "<f4")}


def _numbers(values: np.ndarray, kind: str) -> Any:
    """Return numbers as the script reads them: an even grid, bytes, or a list with few digits."""
    if values.size > 40:
        with np.errstate(all="ignore"):
            step = (values[-1] - values[0]) / (values.size - 1)
            even = values[0] + step * np.arange(values.size)
            # dates are large numbers, whose steps are rounded
            if np.max(np.abs(values - even)) <= 1e-9 * abs(step) + 4 * np.spacing(np.max(np.abs(values))):
                return {"start": float(values[0]), "step": float(step), "count": values.size}
            size = float(np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values)))
        if size and not SINGLE[0] < size < SINGLE[1]:
            kind = "<f8"
        data = base64.b64encode(values.astype(kind).tobytes()).decode()
        return {"bytes" if kind == "<f4" else "wide": data}
    digits = 9 if kind == "<f4" else 16
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]


def scripts(*names: str) -> dict[str, Any]:
    """Return scripts of the package, and the digest by which the policy of a page admits them, for its template."""
    text = "\n".join((files("optid") / "show" / "templates" / name).read_text(encoding="utf-8") for name in names)
    return {"script": Markup(text), "digest": base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}


def embed_json(payload: Any) -> Markup:
    """Return a value as JSON that can stand inside a script element: no text in it can end the element."""
    text = json.dumps(payload, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def template(name: str) -> Any:
    """Return a template of the package."""
    return Environment(
        loader=PackageLoader("optid.show"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True).get_template(name)


def versions() -> list[tuple[str, str]]:
    """Return what the page was made with, and when."""
    return [
        ("optid", __version__),
        *((name, version(name)) for name in ("cvxpy", "numpy", "scipy")),
        ("Python", platform.python_version()),
        ("Written", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC")]
