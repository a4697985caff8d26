"""Count the concepts of the house from its code; none of the counts may rise.

    python tests/ratchets.py [--details COUNT] [--lower]

Prints every count beside the recorded one (`ratchets.json`), which `test_ratchets.py` compares; lines are printed.
--details lists what one count is made of; --lower records the counts that have fallen.

The engine names in a formulation are the names of `optid` that its file imports, directly or through another file of
`formulations`: a name imported there from `optid` is one of `optid`. Those behind it count its helpers as well: files
of `formulations` that register nothing.
"""

import argparse
import ast
import json
import re
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).parent.parent
RECORD = Path(__file__).with_name("ratchets.json")
LONG_SIGNATURE = 8
TERMS = ("optid.core.terms.", "optid.core.low_rank.")
STATE_SPACE = ("formulations.state_space", "formulations.simultaneous", "formulations.latent_signals")
PARTICIPLES = set("""begun bent bought broken brought built caught chosen drawn driven fed felt found frozen given gone
grown held hidden kept known laid led left lent lost made meant met paid said seen sent shown spent stuck sought sworn
taken taught thrown told torn understood won worn written""".split())  # not those that are imperatives too: run, read
NOT_PARTICIPLES = set("embed exceed feed need overdamped proceed seed shed speed succeed".split())


class House:
    """The syntax trees of a root's packages `optid` and `formulations`."""

    def __init__(self, root: Path = ROOT) -> None:
        self.root = root
        self.paths = {".".join(p.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): p
                      for package in ("optid", "formulations") for p in sorted((root / package).rglob("*.py"))}
        self.texts = {module: path.read_text(encoding="utf-8") for module, path in self.paths.items()}
        self.trees = {module: ast.parse(text) for module, text in self.texts.items()}
        self.nodes = {module: list(ast.walk(tree)) for module, tree in self.trees.items()}

    @cached_property
    def imports(self) -> dict[str, dict[str, str]]:
        """Per module {local name: module.name} of everything imported from the house, wherever in the file."""
        found: dict[str, dict[str, str]] = {module: {} for module in self.trees}
        for module, nodes in self.nodes.items():
            for node in nodes:
                if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in (
                        "optid", "formulations"):
                    found[module] |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
                elif isinstance(node, ast.Import):
                    found[module] |= {a.asname or a.name: a.name for a in node.names
                                      if a.name.split(".")[0] in ("optid", "formulations")}
        return found

    def origin(self, name: str) -> str:
        """Follow a name of a file of formulations to where it comes from."""
        module, _, last = name.rpartition(".")
        while module.startswith("formulations") and last in self.imports.get(module, {}):
            module, _, last = self.imports[module][last].rpartition(".")
        return f"{module}.{last}"

    @cached_property
    def registered(self) -> dict[str, list[str]]:
        """{module: functions} of what the project registers as formulations, of models and of faults."""
        project = tomllib.loads((self.root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        found = defaultdict(list)
        for group in ("optid.formulations", "optid.fault_formulations"):
            for target in project["entry-points"][group].values():
                module, _, function = target.partition(":")
                found[module].append(function)
        return found

    def helpers(self, module: str) -> set[str]:
        """Return the files of formulations behind one that register nothing; words of constraints are a layer below."""
        found, left = set(), [module]
        while left:
            for name in self.imports[left.pop()].values():
                source = name if name in self.trees else name.rpartition(".")[0]
                if (source.startswith("formulations.") and not source.startswith("formulations.constraints")
                        and source not in self.registered and source not in found):
                    found.add(source)
                    left.append(source)
        return found

    def engine_names(self, modules: Iterable[str]) -> set[str]:
        """Return the names of optid that files of formulations import."""
        names = {self.origin(name) for one in modules for name in self.imports[one].values()}
        return {name for name in names if name.split(".")[0] == "optid"}


def engine_names(house: House, state_space: bool, helped: bool) -> dict[str, int]:
    """{module: number of engine names}, of the formulations with states or of the others, with or without helpers."""
    return {module: len(house.engine_names([module, *(house.helpers(module) if helped else ())]))
            for module in house.registered if (module in STATE_SPACE) == state_space}


def unreadable_formulations(house: House) -> list[str]:
    """Registered formulations whose file states no objective or whose unknowns are not in it.

    An objective is stated by a call of `Minimize`, or by a term of the core in a `Problem`.
    """
    found = []
    for module, functions in house.registered.items():
        called = {part for node in house.nodes[module] if isinstance(node, ast.Call)
                  for part in ast.unparse(node.func).split(".")}
        terms = {local for local, name in house.imports[module].items() if name.startswith(TERMS)}
        if not ("Minimize" in called or "Problem" in called and terms & called):
            found += [f"{module}:{function}" for function in functions]
    return found


def class_names_twice(house: House) -> list[str]:
    """Public class names that more than one class has."""
    places = defaultdict(list)
    for module, nodes in house.nodes.items():
        for node in nodes:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(module)
    return [f"{name}: {', '.join(modules)}" for name, modules in sorted(places.items()) if len(modules) > 1]


def circles(house: House) -> list[str]:
    """Strongly connected files; imports for types and inside functions count."""
    edges = {module: sorted({target for name in house.imports[module].values()
                             for target in [name if name in house.trees else name.rpartition(".")[0]]
                             if target in house.trees and target != module
                             and house.paths[target].name != "__init__.py"}) for module in house.trees}
    return [", ".join(sorted(part)) for part in strongly_connected(edges) if len(part) > 1]


def strongly_connected(edges: Mapping[str, Iterable[str]]) -> Iterator[list[str]]:
    """Tarjan's algorithm (SIAM J. Comput. 1, 1972), with a stack of its own."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    for root in edges:
        if root in index:
            continue
        work = [(root, iter(edges[root]))]
        index[root] = low[root] = len(index)
        stack.append(root)
        while work:
            node, rest = work[-1]
            for other in rest:
                if other not in index:
                    index[other] = low[other] = len(index)
                    stack.append(other)
                    work.append((other, iter(edges[other])))
                    break
                if other in stack:
                    low[node] = min(low[node], index[other])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[node])
                if low[node] == index[node]:
                    at = stack.index(node)
                    yield stack[at:]
                    del stack[at:]


def fault_kind_comparisons(house: House) -> list[str]:
    """Files of faults, but for faults/kinds.py, that compare an attribute `kind` or hold a kind's word beside one."""
    words = kind_words(house)
    found = []
    for module, nodes in house.nodes.items():
        if "faults" not in module or module == "optid.faults.kinds":
            continue
        for node in nodes:
            compared = [node.left, *node.comparators] if isinstance(node, ast.Compare) else (
                [node.subject] if isinstance(node, ast.Match) else [])
            parts = [part for one in compared for part in ast.walk(one)]
            if any(isinstance(part, ast.Attribute) and part.attr == "kind" for part in compared) or any(
                    isinstance(part, ast.Constant) and part.value in words for part in parts):
                found.append(module)
                break
    return found


def kind_words(house: House) -> set[str]:
    """The words of the kinds of faults: the keys of `KINDS` and `PLACES`, wherever they are defined."""
    found = set()
    for module, tree in house.trees.items():
        if not module.startswith("optid.faults"):
            continue
        for node in tree.body:
            names = {ast.unparse(t) for t in node.targets} if isinstance(node, ast.Assign) else set()
            if names & {"KINDS", "PLACES"} and isinstance(node.value, ast.Dict):
                found |= {key.value for key in node.value.keys if isinstance(key, ast.Constant)}
    return found


def long_signatures(house: House) -> list[str]:
    """Functions of eight or more arguments."""
    return [f"{module}:{node.name}" for module, nodes in house.nodes.items() for node in nodes
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            and len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs) >= LONG_SIGNATURE]


def bare_participles(house: House) -> list[str]:
    """Public functions that are named by one participle, properties left out: these say what something is."""
    return [f"{module}:{node.name}" for module, nodes in house.nodes.items() for node in nodes
            if isinstance(node, ast.FunctionDef) and is_participle(node.name)
            and not any("property" in ast.unparse(one) for one in node.decorator_list)]


def is_participle(name: str) -> bool:
    """Whether a name is one past participle."""
    return name in PARTICIPLES or bool(re.fullmatch(r"[a-z]+ed", name)) and name not in NOT_PARTICIPLES


def lines(paths: Iterable[Path]) -> int:
    """Number of lines of files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def counts(house: House) -> dict[str, int]:
    """All counts by name."""
    return {name: value if isinstance(value, int) else max(value.values()) if isinstance(value, dict) else len(value)
            for name, value in details(house).items()}


def details(house: House) -> dict[str, int | list[str] | dict[str, int]]:
    """What every count is made of."""
    return {
        "engine names in a state-space formulation": engine_names(house, True, False),
        "engine names in another formulation": engine_names(house, False, False),
        "engine names behind a state-space formulation": engine_names(house, True, True),
        "engine names behind another formulation": engine_names(house, False, True),
        "registered formulations that cannot be read in their file": unreadable_formulations(house),
        "public class names with two meanings": class_names_twice(house),
        "circles of imports": circles(house),
        "files that compare a fault's kind": fault_kind_comparisons(house),
        "functions of eight or more arguments": long_signatures(house),
        "public functions named by a bare participle": bare_participles(house),
        "lines of optid and formulations": lines(house.paths.values()),
        "lines of tests": lines(sorted((house.root / "tests").rglob("*.py"))),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--details", metavar="COUNT", help="a word of the name of a count")
    parser.add_argument("--lower", action="store_true")
    options = parser.parse_args()
    house = House()
    now, recorded = counts(house), json.loads(RECORD.read_text()) if RECORD.exists() else {}
    for name, count in now.items():
        print(f"{count:7,d}  {name}" + (f" (recorded: {recorded[name]:,d})" if name in recorded else ""))
        if options.details and options.details in name:
            made_of = details(house)[name]
            rows = made_of if isinstance(made_of, list) else Counter(made_of).most_common() if isinstance(
                made_of, dict) else []
            print(*(f"           {row if isinstance(row, str) else f'{row[1]:4d} {row[0]}'}" for row in rows), sep="\n")
    if options.lower:
        RECORD.write_text(json.dumps({name: min(count, recorded.get(name, sys.maxsize))
                                      for name, count in now.items() if not name.startswith("lines")}, indent=2)
                          + "\n")


if __name__ == "__main__":
    main()
