"""Back ends by their word, and the choice of one for a programme.

They register in the entry-point group ``optid.backends``; the target is a `BackEnd` or a function that returns several.
"""

from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from optid.backends.back_end import Answer, BackEnd, Settings
from optid.errors import LookupFailed, SolverMissing, StructureError, nearest
from optid.program.solution import Status

if TYPE_CHECKING:
    from optid.core.problem import Problem

GROUP = "optid.backends"


@cache
def back_ends() -> dict[str, BackEnd]:
    """Return every registered back end by name, installed or not."""
    found: dict[str, BackEnd] = {}
    for point in entry_points(group=GROUP):
        try:
            target = point.load()
            several: Iterable[BackEnd] = (target,) if isinstance(target, BackEnd) else tuple(target())
        except Exception as error:  # one broken plug-in must not take the other solvers away
            several = (BackEnd(point.name, frozenset(), _absent, installed=False, about="cannot be loaded",
                               broken=f"{point.value} fails: {type(error).__name__}: {error}"),)
        for back_end in several:
            found[back_end.name] = back_end
    return found


def _absent(problem: "Problem", settings: Settings) -> Answer:
    return Answer(Status.FAILED, "cannot be loaded")


def find(name: str) -> BackEnd:
    """Look a back end up by its word, in any case.

    Raises:
        LookupFailed: unknown word; names the nearest.
        SolverMissing: known but not installed; the message has the pip line.
    """
    known = back_ends()
    back_end = known.get(name.lower())
    if back_end is None:
        raise LookupFailed(f"no solver is called {name!r}. {nearest(name.lower(), known)}")
    if back_end.broken:
        raise SolverMissing(f"solver {back_end.name!r} cannot be loaded: {back_end.broken}")
    if not back_end.installed:
        how = f"pip install {back_end.pip}" if back_end.pip else "it needs its vendor's package and licence"
        raise SolverMissing(f"solver {back_end.name!r} is not installed: {how}")
    return back_end


AUTO: dict[str, tuple[str, ...]] = {
    "linear": ("lstsq",), "rank-one": ("gauss_newton",), "nuclear": ("admm",), "group-sparse": ("block_descent",),
    "small NLP": ("uno", "ipopt"), "NLP": ("ipopt", "uno"), "convex": ("clarabel", "scs"),
}
"""What `choose` chooses from: the first installed back end of a structure or class of programme."""


def choose(problem: "Problem") -> tuple[BackEnd, str]:
    """Choose a back end by class and size of the programme, and say why.

    Raises:
        StructureError: when no installed back end accepts the programme.
    """
    for back_end in sorted(back_ends().values(), key=lambda one: one.name not in AUTO.get(one.form, ())):
        form = back_end.form_of(problem) if back_end.installed else None
        if form is not None and back_end.exploits(problem):
            return back_end, f"{back_end.name}: {form.about}"
    from optid.core.statement import class_of, count_variables

    kind, size = class_of(problem), count_variables(problem)
    for name in AUTO["convex" if kind != "NLP" else "small NLP" if size <= 200 else "NLP"]:
        back_end = back_ends().get(name)
        if back_end is not None and back_end.installed and kind in back_end.classes:
            return back_end, f"{name}: class {kind}, {size} unknowns"
    raise StructureError(f"no installed back end accepts a programme of class {kind}; see `optid solvers`")


FALLBACKS = ("daqp", "qoco", "highs", "cvxopt", "ipopt")
"""Convex back ends that take over from one chosen automatically, in this order; IPOPT comes with optid."""


def fallbacks(problem: "Problem", failed: str) -> Iterator[BackEnd]:
    """Yield the installed back ends that can solve a programme in place of one that gave no usable answer."""
    from optid.core.statement import class_of

    names = AUTO["NLP"] if class_of(problem) == "NLP" else FALLBACKS if failed in AUTO["convex"] else ()
    for name in names:
        back_end = back_ends().get(name) if name != failed else None
        if back_end is not None and back_end.installed and not back_end.refuses(problem):
            yield back_end
