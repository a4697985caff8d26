"""Parts that every HTML page has: the template, figures that stand inside it, and what it was made with."""

import platform
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from optid import __version__
from optid.show.svg import inline

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def template(name: str) -> Any:
    """Return a template of the package."""
    return Environment(
        loader=PackageLoader("optid.show"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    ).get_template(name)


def versions() -> list[tuple[str, str]]:
    """Return what the page was made with, and when."""
    return [
        ("optid", __version__),
        *((name, version(name)) for name in ("cvxpy", "numpy", "scipy")),
        ("Python", platform.python_version()),
        ("Written", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
    ]


def figure(name: str, draw: Callable[[], "Figure"], caption: str) -> dict[str, Any]:
    """Return a figure for the macro of the same name.

    Args:
        name: prefix of the identifiers inside.
        draw: makes the figure.
        caption: what stands below it, and for screen readers in place of it.
    """
    return {"svg": inline(draw(), name, caption), "caption": caption}
