"""A model as straight-line code: every operation of its step one assignment, in C or in structured text for a PLC."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optid.errors import StructureError

KEYWORDS = frozenset("""
alignas alignof auto bool break case char const constexpr continue default do double else enum extern false float for
goto if inline int long main nullptr register restrict return short signed sizeof static struct switch thread_local true
typedef typeof union unsigned void volatile while""".split())  # of C99 to C23, without those that begin with "_"

# of IEC 61131-3: words of the language, types, standard functions and function blocks that a name could be
ST_KEYWORDS = frozenset("""
abs acos action add and any array asin at atan bool by byte case char concat configuration constant continue cos ctd
ctu ctud date delete div do dint dt dword else elsif end eq exit exp expt f_edge f_trig false find for from function
function_block ge gt if implements in initial_step insert int interface internal interval le left len limit lint ln log
lreal lt lword max method mid min mod move mul mux namespace ne non_retain not null of on or overlap override own
private program protected public r_edge r_trig read_only read_write real ref ref_to repeat replace resource retain
return right rol ror rs rtc sel sema shl shr sin single sint sqrt sr step string struct sub super t tan task then this
time to tod tof ton tp transition true trunc type udint uint ulint until usint using var wchar while with within word
write wstring xor""".split())

# operations of CasADi: in C, in structured text, "" where it has none
FORMULAS: dict[str, tuple[str, str]] = {
    "ASSIGN": ("{0}", "{0}"), "NEG": ("-{0}", "-{0}"), "LIFT": ("{0}", "{0}"),
    "ADD": ("{0} + {1}", "{0} + {1}"), "SUB": ("{0} - {1}", "{0} - {1}"),
    "MUL": ("{0} * {1}", "{0} * {1}"), "DIV": ("{0} / {1}", "{0} / {1}"), "INV": ("1.0 / {0}", "1.0 / {0}"),
    "SQ": ("{0} * {0}", "{0} * {0}"), "TWICE": ("2.0 * {0}", "2.0 * {0}"),
    "POW": ("pow({0}, {1})", "EXPT({0}, {1})"), "CONSTPOW": ("pow({0}, {1})", "EXPT({0}, {1})"),
    "LOG": ("log({0})", "LN({0})"), "FABS": ("fabs({0})", "ABS({0})"),
    "FMIN": ("fmin({0}, {1})", "MIN({0}, {1})"), "FMAX": ("fmax({0}, {1})", "MAX({0}, {1})"),
    "LT": ("{0} < {1}", "SEL({0} < {1}, 0.0, 1.0)"), "LE": ("{0} <= {1}", "SEL({0} <= {1}, 0.0, 1.0)"),
    "EQ": ("{0} == {1}", "SEL({0} = {1}, 0.0, 1.0)"), "NE": ("{0} != {1}", "SEL({0} <> {1}, 0.0, 1.0)"),
    "NOT": ("{0} == 0.0", "SEL({0} = 0.0, 0.0, 1.0)"),
    "AND": ("{0} != 0.0 && {1} != 0.0", "SEL(({0} <> 0.0) AND ({1} <> 0.0), 0.0, 1.0)"),
    "OR": ("{0} != 0.0 || {1} != 0.0", "SEL(({0} <> 0.0) OR ({1} <> 0.0), 0.0, 1.0)"),
    "IF_ELSE_ZERO": ("{0} != 0.0 ? {1} : 0.0", "SEL({0} <> 0.0, 0.0, {1})"),
    "SIGN": ("({0} > 0.0) - ({0} < 0.0)", "SEL({0} > 0.0, SEL({0} < 0.0, 0.0, -1.0), 1.0)"),
    "SINH": ("sinh({0})", "(EXP({0}) - EXP(-{0})) / 2.0"), "COSH": ("cosh({0})", "(EXP({0}) + EXP(-{0})) / 2.0"),
    "TANH": ("tanh({0})", "SEL({0} < 0.0, 1.0, -1.0) * (1.0 - EXP(-2.0 * ABS({0}))) / (1.0 + EXP(-2.0 * ABS({0})))"),
    **{word: (f"{word.lower()}({{0}})", f"{word}({{0}})") for word in "SQRT EXP SIN COS TAN ASIN ACOS ATAN".split()},
    **{word: (f"{word.lower()}({{0}})", "") for word in "FLOOR CEIL ERF ASINH ACOSH ATANH LOG1P EXPM1".split()},
    **{word: (f"{word.lower()}({{0}}, {{1}})", "") for word in "FMOD ATAN2 HYPOT COPYSIGN REMAINDER".split()}}


class Language(NamedTuple):
    """How an assignment is written."""

    place: int  # of its formulas in `FORMULAS`
    assignment: str  # of the target and the formula
    literal: str  # of a number
    name: str  # for messages


C = Language(0, "{} = {};", "{}", "C")
STRUCTURED_TEXT = Language(1, "{} := {};", "LREAL#{}", "IEC 61131-3")


def straight_line(model: Any, language: Language, inputs: Sequence[str], outputs: Sequence[str], state: str,
                  following: str) -> tuple[list[str], int, int]:
    """Write a step of a model: the outputs and the next state from the state and the inputs, one assignment a line.

    Inputs and outputs are named one by one; states are entries of the arrays `state` and `following`. Returned are the
    lines, the length of the array w of intermediate values, and the number of states.

    Raises:
        StructureError: equations that are no plain expressions, an operation that the language does not have.
    """
    import casadi as ca

    function = model.to_casadi()
    x, u = (ca.SX.sym(word, function.size1_in(i)) for i, word in enumerate("xu"))
    step = ca.Function("step", [x, u], [ca.densify(one) for one in function(x, u)])
    operations = {getattr(ca, f"OP_{name}"): (name, pair[language.place]) for name, pair in FORMULAS.items()}
    sources = [[f"{state}[{i}]" for i in range(x.numel())], inputs]
    targets, lines = [[f"{following}[{i}]" for i in range(x.numel())], outputs], []
    held: dict[int, str] = {}  # what stands for an entry of w: a number, an input, a state, or itself
    for k in range(step.n_instructions()):
        code, out, into = step.instruction_id(k), step.instruction_output(k), step.instruction_input(k)
        if code == ca.OP_OUTPUT:
            lines.append(language.assignment.format(targets[out[0]][out[1]], held[into[0]]))
        elif code == ca.OP_CONST:
            held[out[0]] = _number(step.instruction_constant(k), language)
        elif code == ca.OP_INPUT:
            held[out[0]] = sources[into[0]][into[1]]
        else:
            name, formula = operations.get(code, ("", ""))
            if not formula:
                reason = f"has no function for {name.lower()}" if name else (
                    "takes plain expressions; the equations of this model are solved by iteration at every step")
                raise StructureError(f"The model cannot be written: {language.name} {reason}.")
            value = formula.format(*(held[i] for i in into))
            held[out[0]] = f"w[{out[0]}]"
            lines.append(language.assignment.format(held[out[0]], value))
    return lines, max(step.sz_w(), 1), x.numel()


def _number(value: float, language: Language) -> str:
    if not np.isfinite(value):
        raise StructureError(f"The model contains {value}, which {language.name} has no number for.")
    text = repr(float(value))
    text = language.literal.format(text if "." in text else text.replace("e", ".0e"))
    return f"({text})" if text.startswith("-") else text


def to_c(model: Any, path: str | Path, name: str = "model") -> Path:
    """Write a model as one C file without dependencies, for a control loop: the free run, one sample a call.

    ``NAME_step(x, u, y)`` computes the outputs y of a sample from its inputs u and takes the state x to the next one;
    NAME_STATES, NAME_INPUTS and NAME_OUTPUTS are their lengths, NAME_DT is the sampling time. The state is that of
    `to_casadi`; zeros are a start at rest. Iterating equals `model.simulate`. The code allocates nothing.

    Args:
        model: the model.
        path: the file, replaced when it exists.
        name: prefix of the names in C.

    Raises:
        StructureError: a name that C does not take, equations without plain expressions, or as `to_casadi`.
    """
    check_identifier(name, KEYWORDS, "beginning of the names of C functions")
    notes = "\n".join(f" * {comment_line(line)}" for line in description(model))
    up, (kernel, states) = name.upper(), c_kernel(model, f"{name}_sample")
    path = Path(path)
    path.write_text(f"""/*
{notes}
 */
#include <math.h>

#define {up}_STATES {states}
#define {up}_INPUTS {model.m}
#define {up}_OUTPUTS {model.l}
#define {up}_DT {model.dt!r}

{kernel}
/* Compute y (of {up}_OUTPUTS) from x and u (of {up}_STATES, {up}_INPUTS), and take x to the next sample. */
void {name}_step(double *x, const double *u, double *y) {{
  double next[{max(states, 1)}];
  {name}_sample(x, u, next, y);
  for (int i = 0; i < {states}; i++) x[i] = next[i];
}}
""", encoding="utf-8")
    return path


def c_kernel(model: Any, name: str) -> tuple[str, int]:
    """Return the C function name(x, u, next, y) of a step, and the number of states."""
    lines, work, states = straight_line(model, C, [f"u[{c}]" for c in range(model.m)],
                                        [f"y[{o}]" for o in range(model.l)], "x", "next")
    body = "\n".join(f"  {line}" for line in lines)
    return f"""static void {name}(const double *x, const double *u, double *next, double *y) {{
  double w[{work}];
  (void)w, (void)x, (void)u, (void)next, (void)y;
{body}
}}
""", states


def to_st(model: Any, path: str | Path, name: str = "model") -> Path:
    """Write a model as a function block in structured text (IEC 61131-3) for a PLC: the free run, one sample a call.

    Call an instance of it once every sampling time, from a cyclic task. Its inputs and outputs are LREAL and have the
    names of the channels, reduced to letters, digits and single underscores; the state is that of `to_casadi`, zero at
    the start. Iterating equals `model.simulate`.

    Args:
        model: the model.
        path: the file, replaced when it exists.
        name: name of the function block.

    Raises:
        StructureError: a name that the language does not take, a function that it does not have, or as `to_casadi`.
    """
    check_identifier(name, ST_KEYWORDS, "name of a function block in IEC 61131-3")
    taken = ST_KEYWORDS | {"x", "w", "following", name.lower()}
    inputs = identifiers(model.inputs, "u", taken)
    outputs = identifiers(model.outputs, "y", taken | {word.lower() for word in inputs})
    lines, work, count = straight_line(model, STRUCTURED_TEXT, inputs, outputs, "x", "following")
    notes = "\n".join(f" * {comment_line(line, '*', '()')}" for line in description(model))

    def declare(kind: str, names: Iterable[str], more: str = "") -> str:
        return f"VAR{kind}\n" + "".join(f"    {word} : {more}LREAL;\n" for word in names) + "END_VAR\n"

    states = f"ARRAY[0..{count - 1}] OF "
    held = declare("", ["x"], states) if count else ""
    passing = f"    following : {states}LREAL;\n" if count else ""
    body = "\n".join([*lines, *["x := following;"] * bool(count)])
    path = Path(path)
    path.write_text(f"""(*
{notes}
 *)
FUNCTION_BLOCK {name}
{declare("_INPUT", inputs)}{declare("_OUTPUT", outputs)}{held}VAR_TEMP
    w : ARRAY[0..{work - 1}] OF LREAL;
{passing}END_VAR

{body}
END_FUNCTION_BLOCK
""", encoding="utf-8")
    return path


def description(model: Any) -> list[str]:
    """Return lines that say what a model is: its title, channels, equations and sampling time."""
    channels = [f"{kind} {k}: {channel}{f' ({unit})' if unit else ''}" for kind, names, units in (
        ("u", model.inputs, model.input_units), ("y", model.outputs, model.output_units))
        for k, (channel, unit) in enumerate(zip(names, units))]
    return [model.title, *channels, *model.equation().splitlines(), model.sampling]


def identifiers(names: Iterable[str], letter: str, taken: Iterable[str] = ()) -> list[str]:
    """Reduce names to identifiers that differ, whatever their case: letters, digits and single underscores.

    One without a letter at its start, or that is taken, gets the `letter` before it, or a number after it.
    """
    found: list[str] = []
    used = {word.lower() for word in taken}
    for k, name in enumerate(names, start=1):
        word = re.sub("[^A-Za-z0-9]+", "_", name).strip("_")
        if not word or not word[0].isalpha():
            word = f"{letter}_{word}" if word else f"{letter}{k}"
        number, free = 1, word
        while free.lower() in used:
            number += 1
            free = f"{word}_{number}"
        used.add(free.lower())
        found.append(free)
    return found


def check_identifier(name: Any, taken: Iterable[str], what: str) -> None:
    """Refuse a name that is none of what it has to be (`StructureError`)."""
    if not isinstance(name, str) or identifiers([name], "", taken) != [name]:
        raise StructureError(f"name={name!r} is no {what}: use letters, digits and single underscores, a letter first, "
                             "and no word of the language")


def comment_line(line: str, star: str = "*", ends: str = "//") -> str:
    """Return a line that stays inside a comment: no end, start, trigraph, continued line or hidden character."""
    shown = "".join(c if c.isprintable() else f"(U+{ord(c):04X})" for c in line)
    begin, end = map(re.escape, ends)
    mark = re.escape(star)
    apart = re.sub(rf"{mark}(?={end})|{begin}(?={mark})|\?(?=\?)", r"\g<0> ", shown)
    return f"{apart}." if apart.rstrip().endswith("\\") else apart
