"""Pages and pictures that are made when the site is built: commands, formulations, figures, formulas."""

from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

EXIT_CODES = """| code | meaning |
|---|---|
| 0 | done |
| 1 | a defect of optid; `--debug` shows where |
| 2 | the record, an option or a name cannot be used; the message says what to change |
| 3 | no model: the constraints contradict each other, or the programme has no minimum |
| 4 | the solver is missing or failed; of a study, no run was solved |
| 130 | a study was interrupted by Ctrl-C; the next run goes on from there |
"""


class MathML:
    """Formulas as MathML, which browsers draw without a script and without the network."""

    @staticmethod
    def inline(writer: Any, node: nodes.math) -> None:
        """Write a formula inside a line."""
        writer.body.append(convert(node.astext()))
        raise nodes.SkipNode

    @staticmethod
    def block(writer: Any, node: nodes.math_block) -> None:
        """Write a formula on its own line."""
        writer.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
        raise nodes.SkipNode


def save_figures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any], **_: Any) -> str:
    """Save matplotlib figures that a block of a tutorial left in its variables, and return where they stand."""
    space = block_vars["example_globals"]
    done = space.setdefault("_saved_figures", set())
    saved = []
    for value in list(space.values()):
        if isinstance(value, Figure) and id(value) not in done:
            done.add(id(value))
            path = next(block_vars["image_path_iterator"])
            value.savefig(path, dpi=110)
            saved.append(path)
    return figure_rst(saved, gallery_conf["src_dir"]) if saved else ""


def write_commands(folder: Path) -> None:
    """Write the help text of every command, as it is printed on 100 columns."""
    import os

    from typer.main import get_command
    from typer.testing import CliRunner

    from optid.cli.app import app

    folder.mkdir(exist_ok=True)
    runner = CliRunner(env={"COLUMNS": "96", "TERM": "dumb", "NO_COLOR": "1"})
    os.environ.setdefault("COLUMNS", "96")
    parts = ["# Commands", "Every command explains itself with `--help`; this page is made from these texts.",
             "## Exit codes", EXIT_CODES,
             "## Shell completion", "`optid --install-completion` adds completion of commands and options to bash, "
             "zsh, fish or PowerShell; `optid --show-completion` prints the script instead."]
    commands: Any = get_command(app)
    for name, command in sorted(commands.commands.items()):
        for words in [[name], *([name, sub] for sub in sorted(getattr(command, "commands", {})))]:
            text = runner.invoke(app, [*words, "--help"], prog_name="optid").stdout
            body = "\n".join(line.rstrip() for line in text.splitlines()).strip("\n")
            parts += [f"{'#' * (1 + len(words))} optid {' '.join(words)}", f"```text\n{body}\n```"]
    _write(folder / "commands.md", parts)


def write_formulations(folder: Path) -> None:
    """Write the arguments and named variables of every formulation, from its signature and docstring."""
    from optid.descriptions import describe
    from optid.registry import CONSTRAINTS, FORMULATIONS, find_entry_points

    parts = ["# Formulations and constraints", "What `optid.fit(data, NAME, ...)` and `optid fit --formulation NAME` "
             "take. The programmes themselves are on the page [Mathematics](../mathematics.md)."]
    for name, point in sorted(find_entry_points(FORMULATIONS).items()):
        if point.module.split(".")[0] != "formulations":
            continue
        found = describe(point)
        about = found.arguments()
        rows = "\n".join(f"| `{key}` | {_default(one.default)} | {_cell(about.get(key, ''))} |"
                         for key, one in found.options.items())
        parts += [f"## {name}", _cell(found.summary), f"| argument | default | meaning |\n|---|---|---|\n{rows}",
                  f"Source: `{point.module.replace('.', '/')}.py`. Constraints may name: "
                  + (", ".join(f"`{word}`" for word in found.variables) or "see the source") + "."]
    rows = "\n".join(f"| `{name}` | {_cell(describe(point).summary)} |" for name, point in
                     sorted(find_entry_points(CONSTRAINTS).items()) if point.module.startswith("formulations."))
    parts += ["## Constraints", "As words (`--constraint monotone:increasing`, "
              "`constraints=[\"gain:1.0\"]`) or as functions of `formulations.constraints`.",
              f"| word | statement |\n|---|---|\n{rows}"]
    _write(folder / "formulations.md", parts)


def _default(value: Any) -> str:
    return "needed" if value is type(value) or "empty" in repr(value) else f"`{value!r}`"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*").replace("$", "\\$")


def _write(path: Path, parts: list[str]) -> None:
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
