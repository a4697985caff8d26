"""The packages a user would otherwise pick, on the same simulated records: lines of code, time, fit, bad data.

    python benchmarks/peers/run.py [--seeds 20] [--peers sippy slicot] [--rows long] [--environments FOLDER] [--write]

Every peer has a file in ``entries`` with the code that a competent user of the package would write, and an environment
of its own (``python -m venv`` and pip, kept in ``--environments``). The records are simulated once and are the same for
all; every peer is told the same orders, delay and basis, and uses the settings that did best. Fits are scored by
`judging` on samples that none has seen. A fit that takes more than ``--limit`` CPU seconds is stopped; a peer that has
used up ``--budget`` wall seconds in a row does no further seeds, and the table says how many it did. What is done
is kept in ``--results`` and not done again, unless the entry, the records, the judging or optid changed.

Times are medians over seeds of the CPU time of the fit alone: nothing is imported, simulated, read or predicted in it,
and the process has fitted before; one thread. "optid better by" is the mean difference of the one-step and of the
simulation fit over the seeds that both have.

Goals: optid within 0.1 point of the best peer or above in every row; the only one that answers every row; faster than
every Python peer at N = 100,000, at most twice the time of ctrlsys (SLICOT, Fortran). ``--write`` puts the page into
README.md beside this file.
"""

import argparse
from pathlib import Path

from environments import interpreter, named
from lines import count
from records import ROWS, Row, bad_records, write
from running import HERE, digest, run
from table import OURS, Line, cell, equal_task, goals, label, line, rows_text, verdict

import optid

INTRODUCTION = """\
Printed by `python benchmarks/peers/run.py --write`. Every package solves the same simulated records with the
code that a competent user of it would write (`entries/`), told the same orders, delay and basis, at its best
settings, in an environment of its own. Fits are means over seeds on 2000 samples that none has seen, computed
by the same code for all; times are medians of the CPU time of the fit alone, one thread, in a process that
has fitted before. "optid better by" is the mean difference of the one-step and of the simulation fit over the
seeds that both did; a peer that is slow did fewer seeds. Packages without a nonlinearity get u, u^2, u^3 as
inputs. CVXPY cannot pose a state-space fit: its entry poses a long ARX model, and numpy realises it.
"""

CACHE = Path.home() / ".cache" / "optid-peers"


def own_sources() -> list[Path]:
    """The files of the code under test."""
    package = Path(optid.__file__).parent
    return [*package.rglob("*.py"), *(package.parent / "formulations").rglob("*.py")]


def bad_paths(folder: Path) -> dict[str, Path]:
    """The bad records as files."""
    import numpy as np

    found = {}
    for name, record in bad_records().items():
        found[name] = folder / f"bad-{name.replace(' ', '_')}.npz"
        if not found[name].exists():
            folder.mkdir(parents=True, exist_ok=True)
            np.savez(found[name], **record)
    return found


class Comparison:
    """What is run, where, and with what patience."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.entries = [HERE / "entries" / f"{name}.py" for name in options.peers]
        self.pythons = {entry.stem: interpreter(entry, options.environments) for entry in self.entries}
        self.digests = {entry.stem: digest(entry, own_sources() if entry.stem in OURS else ())
                        for entry in self.entries}
        records = digest(HERE / "records.py")[:8]
        self.folder = options.results / f"records-{records}"

    def line(self, entry: Path, row: Row) -> Line:
        """Run an entry on a row."""
        cannot = named(entry, "CANNOT", {}).get(row.kind, "")
        python, missing = self.pythons[entry.stem]
        if cannot or missing:
            return line(entry.stem, 0, {}, cannot or f"does not install: {missing}")
        seeds = list(range(self.options.seeds))
        paths = [write(self.folder, row, seed) for seed in seeds]
        kept = self.options.results / row.name / f"{entry.stem.strip('_')}-{self.digests[entry.stem]}.json"
        found = run(python, entry, row.kind, paths, kept, self.options.limit, self.options.budget)
        results = {seed: found[path.stem] for seed, path in zip(seeds, paths) if path.stem in found}
        return line(entry.stem, count(entry, row.kind), results)

    def equal_task(self, row: Row) -> str:
        """Time of the subspace step of optid beside that of ctrlsys on the records of a row."""
        paths = [write(self.folder, row, seed) for seed in range(self.options.seeds)]
        found = []
        for name in ("optid_subspace", "slicot"):
            if (python := self.pythons.get(name, ("", ""))[0]) == "":
                return f"* {row.title}: the subspace step of {name} was not run."
            kept = self.options.results / row.name / f"{name}-step-{self.digests[name]}.json"
            results = run(python, HERE / "entries" / f"{name}.py", "projected", paths, kept, self.options.limit,
                          self.options.budget)
            found.append({i: results[path.stem] for i, path in enumerate(paths) if path.stem in results})
        return equal_task(found[0], found[1], row.title)

    def bad(self, entry: Path) -> dict[str, str]:
        """What an entry does with bad records."""
        python, missing = self.pythons[entry.stem]
        if missing or "hammerstein" in named(entry, "CANNOT", {}):
            return {}
        good = write(self.folder, ROWS[0], 0)
        paths = bad_paths(self.folder)
        found = {}
        for name, path in (("", good), *paths.items()):
            kept = self.options.results / "bad" / f"{entry.stem.strip('_')}-{path.stem}-{self.digests[entry.stem]}.json"
            found[name] = run(python, entry, "hammerstein", [path], kept, self.options.limit, 1e9)[path.stem]
        reference = found[""].get("one_step", 0.0)
        return {name: verdict(name, found[name], reference) for name in paths}

    def all_bad(self) -> dict[str, dict[str, str]]:
        """What every entry does with bad records."""
        found = {entry.stem: self.bad(entry) for entry in self.entries}
        return {name: words for name, words in found.items() if words}


def page(comparison: Comparison) -> list[str]:
    """Run what is missing and return the page."""
    options = comparison.options
    rows = tuple(row for row in ROWS if row.name in options.rows)
    text = ["# optid and its peers", "", INTRODUCTION]
    table: dict[str, list[Line]] = {}
    for row in rows:
        table[row.name] = []
        for entry in comparison.entries:
            table[row.name].append(comparison.line(entry, row))
            one = table[row.name][-1]
            print(f"{row.name}: {entry.stem}: " + (f"{len(one.scores)} seeds" if one.scores else one.reason[:100]),
                  flush=True)
        text += rows_text(row, table[row.name])
    bad = {} if options.no_bad else comparison.all_bad()
    text += bad_text(bad) + goals(table, rows, bad)[:-1]
    text += [comparison.equal_task(row) for row in rows if row.kind == "state_space"] + [""]
    return text + versions(comparison)


def bad_text(bad: dict[str, dict[str, str]]) -> list[str]:
    """The table of what every entry does with bad records."""
    if not bad:
        return []
    text = ["### Bad data", "",
            "What the code of the first row does with a record that something is wrong with. An answer is one without",
            "a word and with a fit as good as without the trouble (unstable plant: above 90 %).", "",
            "| peer | " + " | ".join(bad_records()) + " |", "|---|---|---|---|---|"]
    for name, words in bad.items():
        text.append(f"| {label(name)} | " + " | ".join(cell(word, 130) for word in words.values()) + " |")
    return [*text, ""]


def versions(comparison: Comparison) -> list[str]:
    """The versions of the packages that the entries name."""
    packages = [name for entry in comparison.entries for name in named(entry, "PACKAGES", [])[:1]]
    return [f"Packages: optid {optid.__version__}, " + ", ".join(packages) + ".", ""]


def main(argv: list[str] | None = None) -> None:
    """Parse the arguments, run, print, write."""
    known = ["optid_", "optid_subspace", "slicot", "casadi_", "cvxpy_", "jax_sysid_", "sippy", "nfoursid_", "fastcan_",
             "sysidentpy_", "python_control"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--peers", nargs="*", choices=known, default=known)
    parser.add_argument("--rows", nargs="*", choices=[row.name for row in ROWS], default=[row.name for row in ROWS])
    parser.add_argument("--environments", type=Path, default=CACHE / "environments")
    parser.add_argument("--results", type=Path, default=CACHE / "results")
    parser.add_argument("--limit", type=float, default=120.0, help="CPU seconds for a fit")
    parser.add_argument("--budget", type=float, default=120.0, help="wall seconds for a peer in a row")
    parser.add_argument("--no-bad", action="store_true", help="leave out the bad records")
    parser.add_argument("--write", action="store_true", help="write README.md beside this file")
    options = parser.parse_args(argv)
    text = page(Comparison(options))
    print("\n".join(text))
    if options.write:
        (HERE / "README.md").write_text("\n".join(text))


if __name__ == "__main__":
    main()
