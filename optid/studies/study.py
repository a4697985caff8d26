"""A study: its definition, the checks of its data, and its runs."""

import tempfile
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from optid.errors import StudyError
from optid.studies.definition import ALL, KEYS, TOP, Definition, installed_solvers
from optid.studies.execution.running import run
from optid.studies.messages import format_keys, problems_of, refuse_study, unknown_keys
from optid.studies.storage.rows import COLUMNS, NAMES
from optid.studies.trial import check_data

HINT = "write texts in quotation marks, paths in single ones, several values in [ ], and one key = value per line"


class Study(Definition):
    """A grid of data x formulations x solvers x seeds, and the limits that hold for every cell.

    From Python the axes may be written more simply, and are entries once the study is built:

        optid.Study("rig", data={"rig": optid.read("rig.csv")}, solvers="all",
                    formulations={"formulation": "arx", "na": 2, "nb": 2})

    Attributes:
        name: title of the study.
        data: the data axis; given as one or several of: `Data`, name of a simulated system, file name, mapping with the
            keys of [[data]] in a study file, {label: any of these}.
        formulations: the formulation axis; given as mappings with the keys of [[formulation]].
        solvers: the solver axis; given as words or mappings with the keys of [[solver]]; "all" for every installed one.
        accuracy: requested relative accuracies; every solver is run at each.
        time_limit: seconds a cell may take.
        memory_limit: MB a cell may take.
        repetitions: how often a cell is run, for its times.
        warm: whether a cell is also solved a second time from its own solution.
        seeds: of the simulated records; their number, or a list.
        holdout: share of a record that is held out.
        folder: where relative file names start.

    Raises:
        StudyError: lists all problems, each with its key. `check_data` checks the files.
    """

    def __init__(self, name: str, data: Any, formulations: Any, solvers: Any, **settings: Any) -> None:
        self._define(f"study {name!r}", 0, [], name=name, data=data, formulations=formulations, solvers=solvers,
                     **settings)

    def _define(self, label: str, words: int, problems: list[tuple[str, str]], /, **values: Any) -> None:
        """Set the fields, or refuse them with the problems that are known already; the first solvers are words."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            found = [(format_keys(keys, words), text) for keys, text in problems_of(error)]
            problems += [one for one in found if one[0] not in dict(problems)]
        refuse_study(label, problems)

    @classmethod
    def from_toml(cls, path: str | Path) -> "Study":
        """Read a study file; relative data files are relative to its folder.

        Raises:
            StudyError: every problem with its key, unreadable data included.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise StudyError(f"study file {path} cannot be read: {error.strerror or error}") from None
        except UnicodeDecodeError as error:
            raise StudyError(f"{path} has a problem:\n  a study file must be UTF-8: {error}") from None
        return cls.from_text(text.removeprefix("\ufeff"), path.parent, str(path), path.stem)

    @classmethod
    def from_text(cls, text: str, folder: str | Path = ".", label: str = "the study", title: str = "study") -> "Study":
        """Read a study from TOML text, and check its data.

        Args:
            text: content of a study file.
            folder: folder of relative data files.
            label: name of the text in messages.
            title: default title.

        Raises:
            StudyError: as for `from_toml`.
        """
        try:
            raw = tomllib.loads(text.replace("\r\n", "\n"))
        except RecursionError:
            raise StudyError(f"{label} has a problem:\n  lists or tables are nested too deeply") from None
        except ValueError as error:  # not TOML, or an integer with too many digits for Python
            raise StudyError(f"{label} has a problem:\n  {error}; {HINT}") from None
        problems = [(format_keys(keys, 0), text) for keys, text in unknown_keys(raw, TOP)]
        for key in KEYS:
            if not isinstance(raw.get(key, []), list):
                how = f"[[{key}]], with two brackets" if isinstance(raw[key], dict) else f"tables, [[{key}]]"
                problems.append((key, f"must be written as {how}"
                                 + (", or at the top solvers = \"auto\"" if key == "solver" else "")))
        words, tables = raw.get("solvers", []), raw.get("solver", [])
        words = installed_solvers() if words in (ALL, [ALL]) else words if isinstance(words, list) else [words]
        settings = {key: value for key, value in raw.items() if key in TOP and key not in ("solvers", *KEYS)}
        study = cls.__new__(cls)
        study._define(label, len(words), problems, **{
            "name": title, **settings, "data": raw.get("data", []), "formulations": raw.get("formulation", []),
            "solvers": [*words, *tables] if isinstance(tables, list) else words, "folder": Path(folder)})
        check_data(study, label)
        return study

    @classmethod
    def example(cls) -> "Study":
        """Return the built-in study."""
        text = files("optid.studies").joinpath("example.toml").read_text(encoding="utf-8")
        return cls.from_text(text, label="the built-in study")

    def check_data(self) -> None:
        """Read every data file, build every formulation and try solver options on a short record, once.

        Raises:
            StudyError: lists missing or unreadable files and columns; if there are none, the formulations whose
                arguments or constraints fit none of their data, and options with which a solver fails.
        """
        check_data(self)

    def run(self, db: str | Path | None = None, **settings: Any) -> Any:
        """Run the remaining cells of the study and return all rows.

        Args:
            db: database file, from which an interrupted study goes on; a temporary one when not given.
            settings: workers, executor, progress, accept_changed_data and retry of
                `optid.studies.execution.running.run`.

        Returns:
            A pandas frame with the columns of `optid.studies.storage.rows`; a list of dictionaries where pandas is not
            installed.
        """
        with tempfile.TemporaryDirectory() as temporary:
            rows = run(self, db or Path(temporary) / "study.sqlite", **settings)
        try:
            import pandas as pd
        except ImportError:
            return rows
        kinds = {"number": "float64", "integer": "Int64", "flag": "boolean"}
        frame = pd.DataFrame(rows, columns=list(NAMES))
        frame = frame.astype({c.name: "bool" if c.kind == "flag" and c.always else kinds[c.kind]
                              for c in COLUMNS if c.kind in kinds})
        frame["started"] = pd.to_datetime(frame["started"], utc=True)
        return frame
