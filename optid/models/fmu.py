"""A model as an FMU for co-simulation (FMI 2.0): generated C, its description and a library built from both."""

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Sequence
from importlib.resources import files as resources
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from optid.arrays import Array
from optid.errors import OptidError, StructureError
from optid.models import files
from optid.models.experiments import state_like
from optid.models.generated_code import KEYWORDS, c_kernel, check_identifier, comment_line, description, identifiers

SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0, "d": 86400.0}  # time of an FMU is in seconds
PLATFORMS = {("linux", "x86_64"): ("linux64", ".so"), ("darwin", "x86_64"): ("darwin64", ".dylib"),
             ("darwin", "arm64"): ("darwin64", ".dylib"), ("win32", "AMD64"): ("win64", ".dll")}
OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC", "-fvisibility=hidden",
           "-DFMI2_OVERRIDE_FUNCTION_PREFIX")
WRITTEN = (1980, 1, 1, 0, 0, 0)  # date of the files inside, so that one model gives one file


def to_fmu(model: Any, path: str | Path, name: str | None = None, *, x0: Any = None, binary: bool = True) -> Path:
    """Write a model as an FMU, for co-simulation in Simulink, Modelica tools, FMPy and others: the free run.

    It takes a sample every dt, from the inputs that are set at that moment, and holds its outputs in between;
    communication steps may have any length. With steps of dt the outputs equal `model.simulate`. Channels are variables
    with their names, reduced to letters, digits and single underscores; the states (x1, x2, ..., those of `to_casadi`)
    may be set before the start. It contains the C source, and the library for this machine.

    Args:
        model: the model. A `ContinuousModel` is sampled first: ``model.to_discrete(dt).to_fmu(...)``.
        path: the file, ending in .fmu, replaced when it exists.
        name: identifier of the model; the name of the file, reduced likewise, when not given.
        x0: state at the start; zero, or the usual start of a physical model, when not given.
        binary: whether to build the library, with gcc; an FMU of sources alone serves tools that compile it.

    Raises:
        StructureError: another ending, a name that C does not take, an x0 that cannot be read, a unit of time that is
            not known in seconds, or as `to_c`.
        OptidError: there is no C compiler, it fails, or FMI 2.0 has no libraries for this machine.
    """
    path = Path(path)
    if path.suffix != ".fmu":
        raise StructureError(f"{path.name}: the name of an FMU must end in .fmu.")
    name = identifiers([path.stem], "model", KEYWORDS)[0] if name is None else name
    check_identifier(name, KEYWORDS, "identifier of C")
    if model.time_unit not in SECONDS:
        raise StructureError(f"The time of an FMU is in seconds; the model counts in {model.time_unit!r}. Use a model "
                             f"with one of the units {', '.join(filter(None, SECONDS))}.")
    kernel, states = c_kernel(model, "sample")
    start = getattr(model, "start", np.zeros(states)) if x0 is None else np.ravel(state_like(x0, _shape(model, states)))
    inputs = identifiers(model.inputs, "u")
    outputs = identifiers(model.outputs, "y", inputs)
    names = [*inputs, *outputs, *identifiers([f"x{i + 1}" for i in range(states)], "x", [*inputs, *outputs])]
    dt = model.dt * SECONDS[model.time_unit]
    guid = str(uuid.uuid5(uuid.NAMESPACE_URL, repr((name, names, kernel, start.tolist(), dt))))
    source, described = _source(model, name, names, kernel, start, dt, guid), _xml(model, name, names, start, dt, guid)
    parts = {"modelDescription.xml": described.encode(), f"sources/{name}.c": source.encode()}
    if binary:
        folder, ending = _platform()
        parts[f"binaries/{folder}/{name}{ending}"] = _library(source)
    with files.complete(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in parts.items():
            archive.writestr(zipfile.ZipInfo(file, WRITTEN), content, zipfile.ZIP_DEFLATED)
    return path


def _shape(model: Any, states: int) -> tuple[int, ...]:
    """The shape of a state that the user gives: rows of a transfer function, otherwise a vector."""
    return (states // model.l, model.l) if hasattr(model, "numerators") else (states,)


def _source(model: Any, name: str, names: Sequence[str], kernel: str, start: Array, dt: float, guid: str) -> str:
    lines = "\n".join(f" * {comment_line(line)}" for line in description(model))
    frame = (resources("optid") / "models" / "templates" / "fmi2.c").read_text(encoding="utf-8")
    listed = ", ".join(f'"{word}"' for word in names)
    return f"""/*
{lines}
 */
#include <math.h>

#define MODEL {name}
#define GUID "{{{guid}}}"
#define INPUTS {model.m}
#define OUTPUTS {model.l}
#define STATES {len(start)}
#define SAMPLING_TIME {dt!r}

static const char *const NAMES[] = {{{listed}}};
static const double START[] = {{{', '.join(map(repr, start.tolist())) or 0.0}}};

{kernel}
{frame}"""


def _xml(model: Any, name: str, names: Sequence[str], start: Array, dt: float, guid: str) -> str:
    """Describe the variables, in the order of their value references."""
    step, m = model.to_casadi(), model.m
    direct = np.array(step.jac_sparsity(1, 1)).reshape(model.l, m)
    channels = [*model.inputs, *model.outputs]
    units = [*model.input_units, *model.output_units]
    kinds = ['causality="input" variability="continuous"'] * m + [
        'causality="output" variability="continuous" initial="calculated"'] * model.l + [
        'causality="local" variability="discrete" initial="exact"'] * len(start)
    values = [' start="0.0"'] * m + [""] * model.l + [f' start="{value!r}"' for value in start.tolist()]
    variables = []
    for k, (word, kind, value) in enumerate(zip(names, kinds, values)):
        unit = f" unit={quoteattr(units[k])}" if k < len(units) and units[k] else ""
        about = f" description={quoteattr(channels[k])}" if k < len(channels) else ""
        variables.append(f'<ScalarVariable name="{word}" valueReference="{k}" {kind}{about}><Real{value}{unit}/>'
                         "</ScalarVariable>")
    defined = "".join(f"<Unit name={quoteattr(unit)}/>" for unit in dict.fromkeys(filter(None, units)))
    acting = [" ".join(str(c + 1) for c in np.flatnonzero(row)) for row in direct]
    outputs = "\n".join(f'<Unknown index="{m + o + 1}" dependencies="{inputs}"/>' for o, inputs in enumerate(acting))
    first = "\n".join(f'<Unknown index="{m + o + 1}"/>' for o in range(model.l))
    lines = "\n".join(variables)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{{{guid}}}"
 description={quoteattr(f"{model.title}, {model.sampling}")} generationTool="optid" variableNamingConvention="flat">
<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUstate="true"
 canSerializeFMUstate="true"><SourceFiles><File name="{name}.c"/></SourceFiles></CoSimulation>
{f"<UnitDefinitions>{defined}</UnitDefinitions>" if defined else ""}
<LogCategories><Category name="logStatusError"/></LogCategories>
<DefaultExperiment startTime="0.0" stepSize="{dt!r}"/>
<ModelVariables>
{lines}
</ModelVariables>
<ModelStructure>
<Outputs>
{outputs}
</Outputs>
<InitialUnknowns>
{first}
</InitialUnknowns>
</ModelStructure>
</fmiModelDescription>
"""


def _platform() -> tuple[str, str]:
    """Return the folder and the ending of libraries of this machine."""
    here = sys.platform, platform.machine()
    if here not in PLATFORMS:
        raise OptidError(f"FMI 2.0 has no name for libraries of {' '.join(here)}: pass binary=False for an FMU of "
                         "sources, which the tool compiles.")
    return PLATFORMS[here]


def _library(source: str) -> bytes:
    """Compile a source into a shared library."""
    compiler = shlex.split(os.environ.get("CC", "")) or list(filter(shutil.which, ("gcc", "cc", "clang")))[:1]
    if not compiler:
        raise OptidError("There is no C compiler (gcc, cc or clang): install one, or pass binary=False for an FMU of "
                         "sources, which the tool compiles.")
    with tempfile.TemporaryDirectory() as folder:
        code, library = Path(folder) / "model.c", Path(folder) / "library"
        code.write_text(source, encoding="utf-8")
        run = subprocess.run([*compiler, *OPTIONS, str(code), "-o", str(library), "-lm"], capture_output=True,
                             text=True, check=False)
        if run.returncode:
            raise OptidError(f"{compiler[0]} cannot build the FMU: {run.stderr.strip()[:500]}")
        return library.read_bytes()
