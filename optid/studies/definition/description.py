"""The description of a study: data, formulations and solvers with their labels, and the settings of every cell."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.resources import files
from pathlib import Path
from typing import Any

from optid.data.record import Data
from optid.errors import StudyError

HINT = "write texts in quotation marks, paths in single ones, several values in [ ], and one key = value per line"


@dataclass(frozen=True)
class DataEntry:
    """One entry of the data axis: files, a record in memory, or a simulated system at several lengths and noises."""

    name: str  # its label
    files: tuple[str, ...] = ()  # one experiment each, relative to the folder of the study
    system: str | None = None  # name of a simulated system (`optid.studies.sources.systems`)
    record: Data | None = field(default=None, repr=False)  # in memory, from Python only
    samples: tuple[int, ...] = ()  # lengths of the simulated records; empty for the system's own
    noise: tuple[float, ...] = ()  # standard deviations relative to the noise-free output; empty for the system's own
    options: Mapping[str, Any] = field(default_factory=dict)  # how the files are read: `entries.READING`


@dataclass(frozen=True)
class FormulationEntry:
    """One entry of the formulation axis."""

    name: str  # its label
    formulation: str  # registered name
    constraints: tuple[str, ...] = ()  # named constraints as texts, such as "monotone:increasing"
    options: Mapping[str, Any] = field(default_factory=dict)  # arguments as on the command line
    data: tuple[str, ...] = ()  # labels of the data entries it is for; empty for all

    def is_for(self, entry: DataEntry) -> bool:
        """Whether it is run on a data entry."""
        return not self.data or entry.name in self.data


@dataclass(frozen=True)
class SolverEntry:
    """One entry of the solver axis."""

    name: str  # its label
    solver: str  # name of the back end, or "auto"
    accuracy: tuple[float, ...] = ()  # requested accuracies in place of those of the study
    options: Mapping[str, Any] = field(default_factory=dict)  # native options of the solver


@dataclass(frozen=True)
class Study:
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
        data_checked: whether `check_data` has passed.

    Raises:
        StudyError: lists all problems. `check_data` checks the files.
    """

    name: str
    data: tuple[DataEntry, ...] | Any
    formulations: tuple[FormulationEntry, ...] | Any
    solvers: tuple[SolverEntry, ...] | Any
    accuracy: tuple[float, ...] | Any = (1e-8,)
    time_limit: float = 60.0
    memory_limit: float = 2000.0
    repetitions: int = 1
    warm: bool = False
    seeds: tuple[int, ...] | Any = (0,)
    holdout: float = 0.3
    folder: Path = field(default_factory=Path, compare=False)
    data_checked: bool = field(default=False, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        from optid.studies.definition.entries import read
        from optid.studies.definition.problems import Problems
        from optid.studies.definition.writing import as_raw

        problems = Problems()
        found = read(as_raw({f.name: getattr(self, f.name) for f in fields(self)}, problems), problems)
        problems.told(f"study {self.name!r}")
        for key, value in found.items():
            object.__setattr__(self, key, value)
        object.__setattr__(self, "folder", Path(self.folder))

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
        """Read a study from TOML text.

        Args:
            text: content of a study file.
            folder: folder of relative data files.
            label: name of the text in messages.
            title: default title.

        Raises:
            StudyError: as for `from_toml`.
        """
        from optid.studies.definition.entries import read
        from optid.studies.definition.problems import Problems
        from optid.studies.definition.trial import note_all

        try:
            raw = tomllib.loads(text.replace("\r\n", "\n"))
        except RecursionError:
            raise StudyError(f"{label} has a problem:\n  lists or tables are nested too deeply") from None
        except ValueError as error:  # not TOML, or an integer with too many digits for Python
            raise StudyError(f"{label} has a problem:\n  {error}; {HINT}") from None
        problems, folder = Problems(), Path(folder)
        found = {"name": title, **read(raw, problems)}
        note_all(folder, found["data"], found["formulations"], found["solvers"], problems)
        problems.told(label)
        study = cls(**found, folder=folder)
        object.__setattr__(study, "data_checked", True)
        return study

    @classmethod
    def example(cls) -> "Study":
        """Return the built-in study."""
        text = files("optid.studies.definition").joinpath("example.toml").read_text(encoding="utf-8")
        return cls.from_text(text, label="the built-in study")

    def to_toml(self) -> str:
        """Return the study as the text of a study file, which `from_text` reads back.

        Raises:
            StudyError: a record in memory, which no file holds.
        """
        from optid.studies.definition.writing import as_toml

        return as_toml(self)

    def check_data(self) -> None:
        """Read every data file, build every formulation and try solver options on a short record, once.

        Raises:
            StudyError: lists missing or unreadable files and columns; if there are none, the formulations whose
                arguments or constraints fit none of their data, and options with which a solver fails.
        """
        from optid.studies.definition.problems import Problems
        from optid.studies.definition.trial import note_all

        if not self.data_checked:
            problems = Problems()
            note_all(self.folder, self.data, self.formulations, self.solvers, problems)
            problems.told(f"study {self.name!r}")
            object.__setattr__(self, "data_checked", True)

    def run(self, db: str | Path | None = None, **settings: Any) -> Any:
        """Run the remaining cells of the study and return all rows.

        Args:
            db: database file, from which an interrupted study goes on; a temporary one when not given.
            settings: workers, scheduler, progress, accept_changed_data and retry of
                `optid.studies.execution.running.run`.

        Returns:
            A pandas frame with the columns of `optid.studies.storage.rows`; a list of dictionaries where pandas is not
            installed.
        """
        from optid.studies.execution.running import run_to_frame

        return run_to_frame(self, db, **settings)
