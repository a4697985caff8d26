"""Write `docs/mathematics.md`: the problem that every formulation states, from the docstring of its file.

python docs/mathematics.py            # writes the file
"""

import ast
import re
import textwrap
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from optid.registry import FAULTS, FORMULATIONS, find_entry_points

ROOT = Path(__file__).parent.parent
PAGE = Path(__file__).with_name("mathematics.md")
ORDER = ("arx", "hammerstein_arx", "prediction_error", "process", "hammerstein_ss", "state_space", "latent_signals",
         "nuclear_subspace", "simultaneous")
HEAD = """# Mathematics

The problem that every formulation states, in the words of its file, which states the same as data: unknowns, terms of
the objective, constraints. This page is written from these files by `docs/mathematics.py`. Proofs, intervals, prices
and the judgement of answers are the same for all: [proofs, intervals and prices](proofs.md).

Records are $u(k) \\in \\mathbb{R}^m$, $y(k) \\in \\mathbb{R}^l$, $k = 1 \\dots N$, and $q^{-1}$ is the delay. A static
function is $f_c(u) = \\eta_c(u)^T \\mu_c$ with basis functions $\\eta_c$; $\\Theta_c = \\mu_c b_c^T$.
"""


def page() -> str:
    """Return the page."""
    names = defaultdict(list)
    for group in (FORMULATIONS, FAULTS):
        for name, point in find_entry_points(group).items():
            if point.module.split(".")[0] == "formulations":
                names[point.module].append(name)
    parts = [HEAD]
    for module in sorted(names, key=lambda one: (one.startswith("formulations.faults"), _place(one))):
        path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        title, _, body = text.partition("\n")
        words = ", ".join(f"`{name}`" for name in sorted(names[module]))
        file = f"File `{path.relative_to(ROOT).as_posix()}`: {words}."
        parts.append("\n\n".join([f"## {_prose(title)}", file, *_paragraphs(body)]) + "\n")
    return "\n".join(parts)


def _place(module: str) -> tuple[int, str]:
    last = module.rpartition(".")[2]
    return (ORDER.index(last) if last in ORDER else len(ORDER), last)


def _paragraphs(body: str) -> Iterator[str]:
    """Yield the paragraphs of a docstring in Markdown: what is indented are formulas."""
    for paragraph in re.split(r"\n\s*\n", body.strip("\n")) if body.strip() else ():
        if paragraph.startswith("    "):
            yield f"```text\n{textwrap.dedent(paragraph)}\n```"
        else:
            yield _prose(paragraph)


def _prose(text: str) -> str:
    """Return text in which single and double backquotes mark code, with no character that Markdown would read."""
    parts = re.split(r"(``.+?``|`.+?`)", text, flags=re.DOTALL)
    return "".join(f"`{part.strip('`')}`" if part.startswith("`") else part.replace("_", "\\_").replace("<", "&lt;")
                   for part in parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
