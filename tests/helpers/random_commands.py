"""Random command lines: subcommands with their options, good, odd and damaged files, in this process."""

import contextlib
import io
import os
import re
import shutil
import sys
import traceback
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import typer.main
from damage import bytes_of
from random_calls import BASES, CONSTRAINTS, limited
from study_rows import append, rows

import optid
from optid.cli.app import app
from optid.faults import diagnose, dictionary
from optid.registry import FORMULATIONS, find_entry_points
from optid.studies.execution.running import run
from optid.studies.study import Study

EXIT_CODES = {0, 2, 3, 4}
"""What docs/build_steps.py documents, without 1 (a defect of optid) and 130 (Ctrl-C)."""

NUMBERS = ["1", "2", "4", "0.1", "0.99", "0", "1", "2", "3", "5", "30", "-1",
           "0.5", "0.05", "0.9", "1e-3", "1e9", "1e400", "99999999999999999999",
           "nan", "inf", "-inf", "x", "", "1,2", " 1", "1e-300"]
NAMES = ["u", "y", "u1", "y1", "t", "run", "0", "1", "nope", "", "u,y", "\x1b[31mred", "=cmd", ",", "u" * 300]
ACCEPTED = [word for word in (*BASES, *CONSTRAINTS) if isinstance(word, str)]
VALUES = {  # by option; then by metavar; a number where neither is known
    "--inputs": NAMES, "--outputs": NAMES, "--time": ["none", "t", "nope", "u", "solve", "fit", "warm", ""],
    "--experiment": ["run", "nope", "u"], "--delimiter": [",", ";", "\\t", "", "ab", "\x00", '"'],
    "--decimal": [".", ",", "", "x", ".."], "--example": [*optid.examples.EXAMPLES, "nope", ""],
    "--scheduler": ["tcp://127.0.0.1:9", "x", ""],
    "--formulation": [*sorted(find_entry_points(FORMULATIONS)), "nope", ""],
    "--solver": ["auto", "auto", "clarabel", "ipopt", "scs", "nope", ""], "--loss": ["squares", "huber", "l1:x", ""],
    "--classes": ["linear", "input functions", "nope"], "--gauge": ["norm", "gain", "b0", "nope"],
    "--kinds": ["bias", "loss", "stuck", "drift", "frozen", "noise", "spike", "nope", "bias,loss"],
    "--method": ["exact", "sparse", "sparse+polish", "set", "nope"],
    "--load": ["pump=1,0", "pump=y1:-1", "pump=1", "pump", "=", "pump=nan,1", "pump=inf,0", "pump=0,0", "u1=1,0"],
    "--disturbance": ["y1", "u1", "pump", "nope", ""], "--zero": ["u1=0", "u1=nan", "u1", "nope=1", "u1=1e300"],
    "--onset": ["unknown", "3", "-1", "x", "1000000"], "--stage": ["auto", "affected only", "all with prior", "nope"],
    "--if-ambiguous": ["auto", "wait", "probe", "robust", "nope"], "--retry": ["time limit", "done", "nope"],
    "--study": ["synthetic", "nope", "", "\x1b[2J"], "--kind": ["multisine", "chirp", "noise", "levels", "nope"],
    "--set": ["prior=tc", "weight=0.1", "nope=1", "x", "=", "na=[1,2]", "basis={}"],
    "--option": ["verbose=1", "max_iter=3", "nope=2", "x", "tol_gap_rel=1e-3"],
    "NAME:SIZE...": ACCEPTED, "NAME:VALUE...": [*ACCEPTED, "none"],
    "--seed": ["0", "1", "-1", "99999999999999999999", "x"]}
SLOW = {"--workers": ["1"], "--effort": ["1", "small", "0", "much", "nan"],
        "--budget": ["1", "0.5", "0", "-1", "nan", "x"], "--draws": ["0", "1", "30", "-1", "x"],
        "--time-limit": ["5", "1", "0", "-1", "nan"], "--repetitions": ["1", "0", "x"],
        "--candidates": ["1", "2", "0", "-1"], "--memory-limit": ["2000", "0", "-5", "nan", "x"],
        "--arl0": ["100", "1000", "0", "-1", "nan", "x"], "--starts": ["1", "2"]}
"""Options that buy time: drawn, and given where they are not drawn, from values that end soon."""

ALWAYS = {"identify": ["--budget", "1", "--workers", "1"], "fit": ["--formulation", "arx"],
          "study run": ["--workers", "1"],
          "compare": ["--workers", "1", "--repetitions", "1", "--time-limit", "5", "--solvers", "clarabel"],
          "isolability": ["--draws", "30"], "monitor": ["--arl0", "300", "--window", "20"],
          "design": ["--candidates", "1"]}
OFTEN = {"look": 2, "fit": 8, "validate": 4, "identify": 1, "compare": 1, "design": 3, "diagnose": 5, "isolability": 3,
         "monitor": 4, "reformulate": 3, "order": 4, "study run": 2, "study report": 2, "study export": 2,
         "study problems": 1,
         "solvers": 0.2, "formulations": 0.2, "constraints": 0.2, "examples": 0.2, "study systems": 0.2,
         "study schema": 0.2}
WRITTEN = {"--report": ".html", "--model": ".json", "--picture": ".png", "--out": ".json", "--export": ".csv",
           "--output": ".csv", "--thresholds": ".json", "--state": ".npz", "--db": ".sqlite"}
STUDY = """name = "small"
solvers = ["clarabel"]
time_limit = 20
[[data]]
file = "record.csv"
[[formulation]]
formulation = "arx"
na = 1
nb = 1
"""


def make_files(folder: Path) -> dict[str, list[Path]]:
    """Write good, odd and damaged files; return them by the kind that an argument asks for."""
    r = np.random.default_rng(5)
    u, y = r.uniform(-1, 1, (120, 1)), np.zeros((120, 1))
    for k in range(1, 120):
        y[k] = 0.6 * y[k - 1] + u[k - 1] ** 3 + 0.01 * r.standard_normal()
    data = optid.Data(u=u, y=y, dt=0.1, inputs=["u1"], outputs=["y1"])
    good = {"record.csv": None, "r.npz": None, "r.npy": None, "r.parquet": None}
    lines = ["t,u1,y1", *(f"{0.1 * k:.1f},{u[k, 0]:.9f},{y[k, 0]:.9f}" for k in range(120))]
    (folder / "record.csv").write_text("\n".join(lines))
    np.savez(folder / "r.npz", u1=u, y1=y)
    np.save(folder / "r.npy", np.hstack([u, y]))
    data.to_pandas().to_parquet(folder / "r.parquet")
    odd = {"empty.csv": "", "header.csv": "t,u1,y1\n", "one.csv": "u1,y1\n1,2", "gaps.csv": "\n".join(
        line if k % 7 else line.rpartition(",")[0] + "," for k, line in enumerate(lines, 1)),
        "huge.csv": "u1,y1\n" + "\n".join(f"{k}e200,{-k}e300" for k in range(40)),
        "flat.csv": "u1,y1\n" + "1,1\n" * 60, "words.csv": "u1,y1\n" + "a,b\n" * 9,
        "hostile.csv": "u\x1b[31m,y\x1b]0;x\x07,=cmd\n" + "\n".join(f"{k % 7},{k % 5},{k % 3}" for k in range(60)),
        "short.csv": "\n".join(lines[:9]), "record\x1b[2J.csv": "\n".join(lines), "text.txt": "hello", "x.json": "{}",
        "deep.json": "[" * 5000, "bad.toml": "name = [", "hostile.toml": 'name = "\x1b[31m"\n\x1b[2J = 3\n',
        "odd.toml": STUDY.replace("20", "-1").replace("arx", "nope")}
    for name, text in odd.items():
        (folder / name).write_text(text)
    (folder / "study.toml").write_text(STUDY)
    append(folder / "study.sqlite", rows(60))
    (folder / "a folder").mkdir()
    run(Study.from_toml(folder / "study.toml"), folder / "real.sqlite", workers=1)
    optid.fit(data, na=1, nb=1, basis="triangular:5", prove=False).model.save(folder / "arx.json")
    broken = optid.Data(u=u, y=y + np.where(np.arange(120) > 60, 0.5, 0.0)[:, None], dt=0.1, inputs=["u1"],
                        outputs=["y1"])
    with warnings.catch_warnings(action="ignore"):
        ss = optid.fit(data, "hammerstein_ss.asivid", nx=2, basis=optid.Polynomial(3), prove=False).model
        ss.save(folder / "ss.json")
        diagnose(ss, broken, dictionary(ss, kinds=["bias"])).save(folder / "d.json")
    table = ["t,u1,y1", *(f"{0.1 * k:.1f},{u[k, 0]:.9f},{broken.y[k, 0]:.9f}" for k in range(120))]
    (folder / "broken.csv").write_text("\n".join(table))
    for k, name in enumerate([*good, "study.toml", "study.sqlite", "ss.json", "d.json"]):
        for i, bad in enumerate(bytes_of((folder / name).read_bytes(), 4, seed=k)):
            (folder / f"bad{i}-{name}").write_bytes(bad)
    every = sorted(folder.iterdir())

    def kind(*preferred: str, ends: str) -> list[Path]:
        return [folder / name for name in preferred] * 25 + [p for p in every if p.suffix in ends.split()] + [
            folder / "absent.csv", folder / "a folder", every[int(r.integers(len(every)))]]

    return {"data": kind("record.csv", "record.csv", "broken.csv", "r.npz", "r.parquet",
                         ends=".csv .npz .npy .parquet .txt"),
            "model": kind("ss.json", "ss.json", "ss.json", ends=".json"),
            "diagnosis": kind("d.json", ends=".json"),
            "file": kind("study.toml", ends=".toml"), "db": kind("study.sqlite", "real.sqlite", ends=".sqlite .toml")}


def commands() -> dict[str, Any]:
    """Return the subcommands by their words."""
    found: dict[str, Any] = {}
    for name, one in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        found |= {f"{name} {sub}": it for sub, it in getattr(one, "commands", {}).items()} or {name: one}
    return found


def draw(seed: int, files: dict[str, list[Path]]) -> tuple[list[str], Path]:
    """Return the words of a command line, most of which make sense, and the file of the standard input."""
    r = np.random.default_rng([seed, 99])

    def one(values: Any) -> Any:
        return values[int(r.integers(len(values)))]

    chances = np.array(list(OFTEN.values())) / sum(OFTEN.values())
    name = str(r.choice(list(OFTEN), p=chances))
    command = commands()[name]
    words, given = [*name.split(), *ALWAYS.get(name, ())], set(ALWAYS.get(name, ()))
    for argument in (p for p in command.params if p.param_type_name == "argument"):
        if argument.name == "name":  # of a formulation
            words += [one(["bj.exact", "fault.profile", "hammerstein_arx.exact", "bj.exct", ""])][: int(r.integers(2))]
            continue
        some = files[{"files": "model", "target": "data"}.get(argument.name, argument.name)]
        if argument.name == "target":
            words.append(one(["rows.csv", "rows.csv", "rows.parquet", "rows.parquet", "rows.xlsx", "no/rows.csv"]))
        elif argument.required or r.random() < 0.9:
            words += [str(one(some)) for _ in range(1 if argument.nargs == 1 or r.random() < 0.95 else 2)]
        if argument.name == "files":
            words.append(str(one(files["data"])))
    options = [p for p in command.params if p.param_type_name == "option"]
    if name == "fit" and r.random() < 0.9:
        words += ["--na", "1", "--nb", "1", "--basis", "polynomial:3"]
    if name == "monitor":
        words += ["--until-end", *(["--follow", str(one(files["data"]))] if r.random() < 0.6 else [])]
        given.add("--follow")
    if name == "design" and r.random() < 0.9:
        words += ["--like", str(one(files["data"]))]
    if name == "study problems":
        words += ["--out", one(["problems", "no/problems", "record.csv"])]
    for option in r.permutation(np.array(options, object))[: int(r.choice([0, 0, 1, 1, 2, 3]))] if options else ():
        if given & {*option.opts}:
            continue
        word = one(option.opts)
        pool = next((VALUES | SLOW)[o] for o in option.opts if o in VALUES | SLOW) if {*option.opts} & {
            *VALUES, *SLOW} else VALUES.get(option.metavar, NUMBERS)
        if option.is_flag:
            words.append(one([*option.opts, *option.secondary_opts]))
        elif (option.metavar or "").startswith("FILE"):
            end = next((WRITTEN[o] for o in option.opts if o in WRITTEN), None)
            words += [word, *([str(one(files["data"]))] if end is None else [one(
                [f"new{end}", f"new{end}", "no/new.x", "a folder", "new", "bad0-ss.json", "study.sqlite"])])]
        else:
            words += [word, *(str(one(pool)) for _ in range(int(r.integers(1, 3)) if option.multiple else 1))]
    return words, one(files["data"])


def trouble(seed: int, files: dict[str, list[Path]], folder: Path) -> str:
    """Run a command in a copy of the folder; return what is wrong with how it ended, nothing where it is well."""
    words, given = draw(seed, files)
    here = folder.parent / f"call {seed}"
    shutil.copytree(folder, here)
    words = [word.replace(str(folder), ".") if word.startswith(str(folder)) else word for word in words]
    text, before = io.StringIO(), (sys.stdin, Path.cwd())
    try:
        os.chdir(here)
        source = here / given.name
        with open(source if source.is_file() else os.devnull) as sys.stdin:
            return _judge(f"{seed}: optid {words}", *_run(words, text), text.getvalue)
    finally:
        sys.stdin = before[0]
        os.chdir(before[1])
        shutil.rmtree(here)


def _run(words: list[str], text: io.StringIO) -> tuple[int, list[Any]]:
    with (warnings.catch_warnings(record=True) as heard, contextlib.redirect_stdout(text),
          contextlib.redirect_stderr(text), limited(150)):
        warnings.simplefilter("always")
        try:
            typer.main.get_command(app).main(words, prog_name="optid")
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except BaseException:
            text.write(traceback.format_exc(limit=-4))
            code = 1
    return code, heard


def _judge(said: str, code: int, heard: list[Any], written: Any) -> str:
    printed = written()
    wrong = [f"exit code {code}"] if code not in EXIT_CODES else []
    wrong += [f"warns {heard[0].category.__name__}: {heard[0].message}"] if heard else []
    wrong += ["bare"] if re.search(r"\[Errno|Traceback|np\.\w+64|<\w+ object at", printed) else []
    wrong += ["says nothing"] if not printed.strip() and code else []
    wrong += [f"prints {raw[0]!r}"] if (raw := re.findall("[\x00-\x08\x0b-\x1f\x7f-\x9f]", printed)) else []
    return f"{said} -> {'; '.join(wrong)}: {printed[-900:]}" if wrong else ""
