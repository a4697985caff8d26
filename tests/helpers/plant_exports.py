"""One record as loggers, historians and spreadsheets export it, and what is read of each file."""

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

N, GAIN, POLE = 240, 2.0, 0.9
LOST = slice(60, 63)
FROZEN = slice(100, 120)
START = datetime(2024, 5, 1, 6)


def record(seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return steps of u and the answer y(k) = 0.9 y(k-1) + 0.2 u(k-1), (N,) each, with a little noise."""
    r = np.random.default_rng(seed)
    u = np.repeat(r.choice([0.0, 1.0, 2.5, 4.0, 5.5], N // 6), 6)
    y = np.zeros(N)
    for k in range(1, N):
        y[k] = POLE * y[k - 1] + (1 - POLE) * GAIN * u[k - 1]
    return u, y + 0.01 * r.standard_normal(N)


U, Y = record()


@dataclass(frozen=True)
class Export:
    """A file and what is read of it.

    Attributes:
        name: of the file.
        about: what is special about it, for the table of the documentation.
        write: returns its bytes.
        dt: sampling time in seconds.
        refusal: what the refusal without words says; empty if the file is read.
        words: what to type, as keywords.
        channels: columns of input and output.
        finding: what is said of the file once it is read.
        missing: samples of the output that are missing with the words.
        scale: of u in the file.
    """

    name: str
    about: str
    write: Callable[[], bytes]
    dt: float = 0.1
    refusal: str = ""
    words: Mapping[str, Any] = field(default_factory=dict)
    channels: tuple[Any, Any] = ("u", "y")
    finding: str = ""
    missing: int = 0
    scale: float = 1.0

    def file(self, folder: Path) -> Path:
        """Write the file into a folder."""
        path = folder / self.name
        path.write_bytes(self.write())
        return path


def table(stamps: list[Any], head: tuple[str, ...] = ("time", "u", "y"), *, mark: str = ",", comma: bool = False,
          before: str = "", after: str = "", encoding: str = "utf-8", u: Any = None, y: Any = None, end: str = "\n",
          tail: str = "") -> bytes:
    """Return a text table with stamps, u and y; `before` stands above the header, `after` below it."""
    text = io.StringIO()
    writer = csv.writer(text, delimiter=mark, lineterminator=tail + end)
    if head:
        writer.writerow(head)
    text.write(after)
    for t, a, b in zip(stamps, U if u is None else u, Y if y is None else y):
        cells = [one if isinstance(one, str) else f"{one:.5f}" for one in (a, b)]
        writer.writerow([*([t] if t is not None else []), *(c.replace(".", ",") if comma else c for c in cells)])
    return (before + text.getvalue()).encode(encoding)


def dated(form: str, step: float, start: datetime = START, n: int = N) -> list[str]:
    """Return stamps in a format."""
    return [(start + timedelta(seconds=step * k)).strftime(form) for k in range(n)]


def counted(step: float = 0.1, digits: int = 1) -> list[str]:
    """Return stamps in seconds."""
    return [f"{step * k:.{digits}f}" for k in range(N)]


def without(rows: slice, values: list[Any]) -> list[Any]:
    """Return values without some rows."""
    return [value for k, value in enumerate(values) if not rows.start <= k < rows.stop]


def _jitter() -> list[str]:
    r = np.random.default_rng(1)
    return [f"{t:.5f}" for t in 0.1 * np.arange(N) + 0.002 * r.uniform(-1, 1, N)]


def _local(offset: bool) -> list[str]:
    """Return local stamps every 5 minutes over the end of summer time in Berlin."""
    found = []
    for k in range(N):
        utc = datetime(2024, 10, 26, 20) + timedelta(minutes=5 * k)
        hours = 2 if utc < datetime(2024, 10, 27, 1) else 1
        text = (utc + timedelta(hours=hours)).isoformat()
        found.append(text + f"+0{hours}:00" if offset else text)
    return found


def _spring() -> list[str]:
    return [(datetime(2024, 3, 31) + timedelta(hours=k / 12 + (k >= 24))).isoformat() for k in range(N)]


def _bad(words: Mapping[int, str], values: np.ndarray) -> list[Any]:
    return [words.get(k, value) for k, value in enumerate(values.tolist())]


def _quality() -> bytes:
    frozen = Y.copy()
    frozen[FROZEN] = Y[FROZEN.start]
    rows = ["Timestamp,OP,OP.Q,PV,PV.Q"] + [
        f"{t},{a},192,{b:.5f},{0 if FROZEN.start <= k < FROZEN.stop else 192}"
        for k, (t, a, b) in enumerate(zip(dated("%Y-%m-%d %H:%M:%S", 1), U, frozen))]
    return "\n".join(rows).encode()


def _long() -> bytes:
    rows = ["Timestamp,Tag,Value"]
    for t, a, b in zip(dated("%Y-%m-%dT%H:%M:%S", 1), U, Y):
        rows += [f"{t},VALVE,{a}", f"{t},LEVEL,{b:.5f}"]
    return "\n".join(rows).encode()


_LABVIEW = ("LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t,\nX_Columns\tOne\n***End_of_Header***\t\n\t\n"
            "Channels\t2\t\nDelta_X\t0,1\t0,1\n***End_of_Header***\t\t\n")
_LOGGER = '"TOA5","logger","CR1000","1234"\n'
_US = dated("%m/%d/%Y %H:%M:%S", 5)
_GERMAN = {"delimiter": ";", "decimal": ",", "date_format": "%d.%m.%Y %H:%M:%S"}
_TAGS = ("TIMESTAMP", "FV1 OP", "TI1 PV")

EXPORTS = (
    Export("plain.csv", "seconds in a column `time`", lambda: table(counted())),
    Export("unit_in_name.csv", "milliseconds in a column `Time (ms)`",
           lambda: table([str(100 * k) for k in range(N)], ("Time (ms)", "u", "y")), finding="in ms, read as seconds"),
    Export("minutes.txt", "minutes in a column `t_min`, tabs between the cells",
           lambda: table([f"{0.5 * k:.1f}" for k in range(N)], ("t_min", "u", "y"), mark="\t"), dt=30.0,
           finding="in min, read as seconds"),
    Export("timestamp.csv", "ISO dates in a column `Timestamp`",
           lambda: table(dated("%Y-%m-%dT%H:%M:%S.%f", 0.1), ("Timestamp", "u", "y"))),
    Export("dates.csv", "dates in a column of any name",
           lambda: table(dated("%Y-%m-%d %H:%M:%S", 2), ("logged", "u", "y")), dt=2.0),
    Export("date_and_time.csv", "the date and the time of day in two columns", lambda: b"\n".join(
        line.replace(b" ", b",", 1) for line in table(dated("%Y-%m-%d %H:%M:%S", 60, datetime(2024, 5, 1, 22)),
                                                      ("Date Time", "u", "y")).split(b"\n")), dt=60.0),
    Export("midnight.csv", "times of day, over midnight",
           lambda: table(dated("%H:%M:%S", 60, datetime(2024, 5, 1, 22)), ("Uhrzeit", "u", "y")), dt=60.0),
    Export("half_day.csv", "a clock of 12 hours",
           lambda: table(dated("%Y-%m-%d %I:%M:%S %p", 600), ("datetime", "u", "y")), dt=600.0),
    Export("epoch.csv", "milliseconds since 1970", lambda: table([str(1714543200000 + 100 * k) for k in range(N)]),
           finding="milliseconds since 1970"),
    Export("excel_days.csv", "days as Excel counts them",
           lambda: table([f"{45413.25 + k / 86400:.8f}" for k in range(N)], ("Zeit", "u", "y")), dt=1.0,
           finding="as of Excel"),
    Export("no_clock.csv", "no clock", lambda: table([None] * N, ("u", "y")), dt=1.0,
           finding="no time column: 1 sample = 1"),
    Export("bare.txt", "no header, blanks between the cells", lambda: "\n".join(
        f"  {a: .6e}  {b: .6e}" for a, b in zip(U, Y)).encode(), dt=1.0, channels=("0", "1"), finding="no header"),
    Export("utf16.csv", "UTF-16 with its mark", lambda: table(counted(), encoding="utf-16")),
    Export("sep.csv", "the line `sep=;` of Excel", lambda: table(counted(), mark=";", before="sep=;\n")),
    Export("trailing.csv", "a delimiter at the end of each row", lambda: table(counted(), tail=",")),
    Export("units_row.csv", "a row of units", lambda: table(counted(), after="s,V,rpm\n"),
           finding="units time s, u V, y rpm"),
    Export("comments.csv", "comment lines", lambda: table(counted(), before="# rig 3\n# 10 Hz\n"),
           refusal="line 1 begins with '#'", words={"comment": "#"}),
    Export("preamble.csv", "lines before the header",
           lambda: table(counted(), before="Report of the plant\ncreated;by;nobody\n"),
           refusal="the header seems to be line 3", words={"skip_rows": 2}),
    Export("logger.dat", "a logger's line, names, units and kinds in quotes",
           lambda: table(dated("%Y-%m-%d %H:%M:%S", 10), _TAGS, before=_LOGGER,
                         after='"TS","%","DEG C"\n"","Smp","Avg"\n'),
           dt=10.0, refusal="the header seems to be line 2", words={"skip_rows": 1}, channels=_TAGS[1:],
           finding="units TIMESTAMP TS, FV1 OP %, TI1 PV DEG C; 1 row of descriptions skipped"),
    Export("historian.csv", "three header rows, US dates, BAD and NO DATA",
           lambda: table(_US, _TAGS, after='"","%","DEG C"\n"","Steam valve","Outlet temperature"\n',
                         u=_bad({50: "NO DATA"}, U), y=_bad({50: "BAD", 51: "BAD"}, Y)), dt=5.0,
           refusal="row 53 after the header holds 'NO DATA'",
           words={"missing": "BAD,NO DATA", "date_format": "%m/%d/%Y %H:%M:%S"}, channels=_TAGS[1:], missing=2),
    Export("markers.csv", "-9999 where a sample is missing", lambda: table(counted(), y=_bad({7: "-9999"}, Y)),
           words={"missing": "-9999"}, missing=1, finding="1 samples are -9999, far from all others"),
    Export("german.csv", "latin-1, semicolons, decimal commas, German dates",
           lambda: table(dated("%d.%m.%Y %H:%M:%S", 1), ("Zeit", "Stellgröße [%]", "Höhe"), mark=";", comma=True,
                         encoding="latin-1"), dt=1.0, refusal="is not UTF-8 text",
           words={"encoding": "latin-1", **_GERMAN}, channels=("Stellgröße [%]", "Höhe")),
    Export("german_utf8.csv", "semicolons, decimal commas, German dates",
           lambda: table(dated("%d.%m.%Y %H:%M:%S", 1), ("Zeit", "u", "y"), mark=";", comma=True), dt=1.0,
           refusal="number with a decimal comma", words=_GERMAN),
    Export("labview.lvm", "LabVIEW, with its header",
           lambda: table(counted(digits=6), ("X_Value", "u", "y", "Comment"), mark="\t", comma=True, before=_LABVIEW
                         ).replace(b".", b",")),
    Export("thousands.csv", "separators of thousands", lambda: table(counted(), u=[f"{1000 * a:,.2f}" for a in U]),
           refusal="separator of thousands", words={"thousands": ","}, scale=1000.0),
    Export("long.csv", "one row for each tag", _long, channels=("VALVE", "LEVEL"), refusal="is a long table"),
    Export("quality.csv", "columns of quality; frozen samples", _quality, dt=1.0,
           words={"quality": "OP.Q:192,PV.Q:192"}, channels=("OP", "PV"), missing=20),
    Export("offsets.csv", "the end of summer time, with offsets", lambda: table(_local(True)), dt=300.0,
           finding="dates with an offset, shown in UTC"),
    Export("summer_ends.csv", "the end of summer time, without offsets", lambda: table(_local(False)), dt=300.0,
           refusal="Daylight saving time ends there", words={"time_zone": "Europe/Berlin"}),
    Export("summer_begins.csv", "the beginning of summer time, without offsets", lambda: table(_spring()), dt=300.0,
           refusal="Daylight saving time begins there", words={"time_zone": "Europe/Berlin"}),
    Export("whole_seconds.csv", "ten samples a second, stamps of whole seconds",
           lambda: table(dated("%Y-%m-%d %H:%M:%S", 0.1)), refusal="10 rows share each time stamp",
           words={"dt": 0.1}, finding="spread evenly"),
    Export("jitter.csv", "a clock with jitter", lambda: table(_jitter()), refusal="The clock has jitter",
           words={"time_tolerance": 0.05}),
    Export("twice.csv", "a row twice", lambda: table([*counted()[:80], *counted()[79:]], u=[*U[:80], *U[79:]],
                                                     y=[*Y[:80], *Y[79:]]), refusal="1 stamp comes twice",
           words={"gaps": "missing"}, finding="counted once"),
    Export("lost.csv", "three rows lost", lambda: table(without(LOST, counted()), u=without(LOST, U.tolist()),
                                                        y=without(LOST, Y.tolist())), refusal="3 rows seem to be lost",
           words={"gaps": "missing"}, finding="counted as missing", missing=3),
    Export("irregular.csv", "irregular stamps", lambda: table(
        [f"{0.1 * k + 0.04 * (k % 3 == 1) + 0.2 * (k // 50):.3f}" for k in range(N)]), refusal="pass resample=",
        words={"resample": "0.1s"}, finding="resampled every 0.1 s"),
)
