"""The convex programmes of a study in standard form, for solvers without optid: a benchmark set.

Every programme is ``minimise x'Px / 2 + q'x + offset subject to A x + s = b, s in K`` with K a product of zero,
non-negative, second-order and semidefinite cones, in this order. Semidefinite blocks are upper triangles by columns,
off-diagonal entries times sqrt(2), as Clarabel takes them. Linear and quadratic programmes are written as MPS, too.
"""

import csv
import warnings
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from optid.core.problem import Problem
from optid.core.statement import class_of, for_solvers, statement_of
from optid.errors import OptidError, StudyError
from optid.program.solution import Solution, Status
from optid.solving.solve import solve
from optid.studies.grid import Cell, cells
from optid.studies.records import load
from optid.studies.storage.store import Store
from optid.studies.study import Study
from optid.studies.trial import build_problem

ACCURACY = 1e-9  # at which objectives are verified


@dataclass(frozen=True, eq=False)
class StandardForm:
    """One programme; see the module for its meaning."""

    P: Any  # (n, n) upper triangle, sparse
    q: np.ndarray  # (n,)
    A: Any  # (m, n), sparse
    b: np.ndarray  # (m,)
    cones: tuple[int, int, tuple[int, ...], tuple[int, ...]]  # rows of zero and non-negative cones, sizes of the others
    offset: float  # constant of the objective

    @property
    def kind(self) -> str:
        """LP, QP, SOCP or SDP."""
        return "SDP" if self.cones[3] else "SOCP" if self.cones[2] else "QP" if self.P.nnz else "LP"


def write_problems(database: str | Path, folder: str | Path, study: str | None = None) -> list[dict[str, Any]]:
    """Write the convex programmes of the cells of a study, and a script that solves them.

    Programmes of procedures that depend on the solutions of earlier ones are those after optid's own solutions.

    Args:
        database: of the study.
        folder: made where it is not there; ``problems.csv`` lists the programmes with their verified objectives.
        study: title, for a database that holds several.

    Returns:
        The lines of ``problems.csv``.

    Raises:
        StudyError: the database holds no text of the study, as for records in memory.
        DatabaseError: the database cannot be read.
        OSError: the folder cannot be written.
    """
    with Store(database) as store:
        texts = {name: text for name, text in store.descriptions().items() if study in (None, name)}
    if not any(texts.values()):
        raise StudyError(f"{database} has no text of a study, from which its problems could be built"
                         + (f": it has {', '.join(map(repr, texts))}" if texts else ""))
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    lines: list[dict[str, Any]] = []
    for text in filter(None, texts.values()):
        problems: dict[tuple[Any, ...], Cell] = {}  # one cell of every record and formulation
        for cell in cells(Study.from_text(text)):
            problems.setdefault((cell.data, cell.samples, cell.noise, cell.seed, cell.formulation), cell)
        for cell in problems.values():
            for program, solution in _programmes(cell):
                if line := _written(folder, len(lines), cell, program, solution):
                    lines.append(line)
    with (folder / "problems.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, ["name", "kind", "variables", "rows", "objective", "data", "formulation"])
        table.writeheader()
        table.writerows(lines)
    script = "solve_problems.py"
    (folder / script).write_bytes(files("optid.studies").joinpath(script).read_bytes())
    return lines


def _programmes(cell: Cell) -> list[tuple[Problem, Solution]]:
    """Return the programmes of a cell with optid's solutions, up to the first failure."""
    found: list[tuple[Problem, Solution]] = []
    with warnings.catch_warnings(), suppress(StopIteration, OptidError, ArithmeticError, np.linalg.LinAlgError):
        warnings.simplefilter("ignore")  # the row of the cell has the reason of a failure
        made = build_problem(cell.formulation_name, load(cell).data, cell.constraints, cell.options)
        procedure: Any = None if isinstance(made, Problem) else made
        problem = for_solvers(made if procedure is None else next(procedure))
        while True:
            solution = solve(problem, accuracy=ACCURACY, time_limit=cell.time_limit, prove=False)
            found.append((problem, solution))
            if procedure is None:
                break
            problem = for_solvers(procedure.send(solution))
    return found


def standard_form(program: Problem) -> StandardForm | None:
    """Return the standard form of a programme; None where it is not convex, or of cones other than those here."""
    if class_of(program) == "NLP":
        return None
    data, _, _ = statement_of(program).problem.get_problem_data("CLARABEL")
    dims = data["dims"]
    offset = float(data["param_prob"].apply_parameters()[-3])  # of (P,) q, offset, A, b
    if dims.exp or dims.p3d or getattr(dims, "pnd", None):
        return None
    n = len(data["c"])
    weights = sp.csc_array(sp.triu(data["P"])) if data.get("P") is not None else sp.csc_array((n, n))
    weights.eliminate_zeros()
    cones = int(dims.zero), int(dims.nonneg), tuple(map(int, dims.soc)), tuple(map(int, dims.psd))
    return StandardForm(weights, np.asarray(data["c"]), sp.csc_array(data["A"]), np.asarray(data["b"]), cones, offset)


def _written(folder: Path, number: int, cell: Cell, program: Problem, solution: Solution) -> dict[str, Any] | None:
    """Write one programme, and return its line; None where it is not convex or its objective could not be verified."""
    form = standard_form(program) if solution.status in (Status.OPTIMAL, Status.LOCAL) else None
    if form is None:
        return None
    name, objective = f"{number:04d}", solution.objective / program.unit
    np.savez_compressed(
        folder / f"{name}.npz", P_data=form.P.data, P_indices=form.P.indices, P_indptr=form.P.indptr, q=form.q,
        A_data=form.A.data, A_indices=form.A.indices, A_indptr=form.A.indptr, b=form.b, zero=form.cones[0],
        nonneg=form.cones[1], soc=np.array(form.cones[2], dtype=int), psd=np.array(form.cones[3], dtype=int),
        offset=form.offset, objective=objective)
    if form.kind in ("LP", "QP"):
        (folder / f"{name}.mps").write_text(mps(form, name), encoding="ascii")
    return {"name": name, "kind": form.kind, "variables": len(form.q), "rows": len(form.b),
            "objective": repr(objective), "data": cell.data, "formulation": cell.formulation}


def mps(form: StandardForm, name: str) -> str:
    """Return a linear or quadratic programme as free MPS text, all variables free."""
    columns, weights = sp.csc_array(form.A), sp.coo_array(form.P)
    lines = [f"NAME {name}", "ROWS", " N objective"]
    lines += [f" {'E' if row < form.cones[0] else 'L'} r{row}" for row in range(len(form.b))]
    lines.append("COLUMNS")
    for j, cost in enumerate(form.q):
        lines.append(f" x{j} objective {float(cost)!r}")
        begin, end = columns.indptr[j], columns.indptr[j + 1]
        lines += [f" x{j} r{i} {float(v)!r}" for i, v in zip(columns.indices[begin:end], columns.data[begin:end])]
    lines += ["RHS", f" rhs objective {-form.offset!r}"]
    lines += [f" rhs r{i} {float(v)!r}" for i, v in enumerate(form.b) if v]
    lines += ["BOUNDS", *(f" FR bound x{j}" for j in range(len(form.q)))]
    if form.P.nnz:
        lines += ["QUADOBJ", *(f" x{i} x{j} {float(v)!r}" for i, j, v in zip(*weights.coords, weights.data))]
    return "\n".join([*lines, "ENDATA", ""])
