"""Figures as SVG inside a page: no external reference, colours that follow the page, unique identifiers."""

import io
import re

import matplotlib
from markupsafe import Markup, escape
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from optid.show.panels import BLUE, GREEN, GRID, INK, MUTED, ORANGE, PANEL, RED

VARIABLES = {INK: "ink", MUTED: "muted", GRID: "grid", PANEL: "panel", BLUE: "blue", ORANGE: "orange", GREEN: "green",
             RED: "red"}
"""Colours of the figures and the variables of the style sheet that take their place."""


def inline(figure: Figure, name: str, label: str) -> Markup:
    """Return the <svg> element of a figure, ready to be placed in an HTML page.

    Args:
        figure: the figure; text becomes outlines, so that it looks the same everywhere.
        name: prefix of the identifiers inside, different for every figure of a page.
        label: what the figure shows, for screen readers.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "optid"}):
        # savefig would lay the figure out twice
        FigureCanvasSVG(figure).print_svg(buffer, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:xlink)?="[^"]*"', "", text).replace("xlink:href", "href")
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = text.replace('href="#', f'href="#{name}-').replace("url(#", f"url(#{name}-")
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, f"var(--{variable})")
    width = re.match(r'<svg[^>]*\bwidth="([0-9.]+)pt"', text)
    natural = f' style="--width: {width[1]}pt"' if width else ""
    text = re.sub(r'\s(width|height)="[0-9.]+pt"', "", text, count=2)
    return Markup(text.replace("<svg", f'<svg role="img" aria-label="{escape(label)}"{natural}', 1))
