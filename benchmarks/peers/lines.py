"""Lines of user code: those of an entry's file that a row needs."""

import ast
from pathlib import Path

NOT_USER = {"PACKAGES", "CANNOT"}


def count(entry: Path, kind: str) -> int:
    """Lines of code, without blank lines, comments and docstrings, reachable from the function of a kind of row.

    Imports count where a name they bring is used.
    """
    source = entry.read_text()
    defined: dict[str, ast.stmt] = {}
    for node in ast.parse(source).body:
        for name in _names(node):
            defined[name] = node
    reached: set[int] = set()
    waiting, seen = [kind], set()
    while waiting:
        name = waiting.pop()
        if name in seen or name not in defined or name in NOT_USER:
            continue
        seen.add(name)
        node = defined[name]
        reached |= _lines(node, source.splitlines())
        waiting += [inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)]
    return len(reached)


def _names(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.Import | ast.ImportFrom):
        return [(alias.asname or alias.name).split(".")[0] for alias in node.names]
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    if isinstance(node, ast.Assign):
        return [target.id for target in node.targets if isinstance(target, ast.Name)]
    return []


def _lines(node: ast.stmt, source: list[str]) -> set[int]:
    found = set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    for inner in ast.walk(node):
        if isinstance(inner, ast.Expr) and isinstance(inner.value, ast.Constant) and isinstance(inner.value.value, str):
            found -= set(range(inner.lineno, (inner.end_lineno or inner.lineno) + 1))
    return {i for i in found if source[i - 1].strip() and not source[i - 1].strip().startswith("#")}
