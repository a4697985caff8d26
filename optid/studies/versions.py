"""The versions that determine the result of a cell: packages, and the source of formulation and simulated system."""

import hashlib
import inspect
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version

from optid.backends.choice import AUTO, back_ends
from optid.registry import FORMULATIONS, registered

ALWAYS = ("optid", "numpy", "scipy", "cvxpy")  # distributions behind every result


@cache
def determining(formulation: str, solver: str, simulated: bool = False) -> dict[str, str]:
    """Return the versions that determine a result, by name.

    They are those of a registered formulation (its distribution and source), of a back end (for "auto" those that it
    chooses from) and, for a simulated record, the source of the systems.
    """
    found = {name: installed(name) for name in ALWAYS}
    point = registered(FORMULATIONS)[formulation]
    if point.dist is not None:
        found[point.dist.name] = point.dist.version
    found[f"source of {formulation}"] = source_hash(point.value.partition(":")[0])
    for name in sorted({name for names in AUTO.values() for name in names}) if solver == "auto" else (solver,):
        found |= _of_back_end(name)
    if simulated:
        found["source of the systems"] = source_hash("optid.studies.sources.systems")
    return found


def installed(distribution: str) -> str:
    """Return the version of a distribution, or "not installed"."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


@cache
def source_hash(module: str) -> str:
    """Return the first 16 digits of the sha256 of a module's source; "unknown" where there is none."""
    from importlib.util import find_spec

    spec = find_spec(module)
    if spec is None or spec.origin is None:
        return "unknown"
    try:
        with open(spec.origin, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]
    except OSError:
        return "unknown"


def _of_back_end(name: str) -> dict[str, str]:
    """Distributions of a back end, those it names for pip and the one its code is in, and its source.

    The source may be edited in place; ours is looked at, too, so that no key depends on how optid was installed.
    """
    back_end = back_ends().get(name)
    if back_end is None:
        return {}
    module = getattr(inspect.getmodule(back_end.run), "__name__", "")
    distributions = {*back_end.pip.split(), *packages_of(module.partition(".")[0])}
    found = {distribution: installed(distribution) for distribution in sorted(distributions)}
    return found | {f"source of {name}": source_hash(module)}


@cache
def packages_of(package: str) -> tuple[str, ...]:
    """Return the distributions that hold a top-level package."""
    return tuple(sorted(set(packages_distributions().get(package, ()))))
