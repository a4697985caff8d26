"""The bench of one page: its record, its fits, and the responses to its requests."""

import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from optid.data.record import Data
from optid.errors import DataError, OptidError
from optid.workbench import views
from optid.workbench.request import Request
from optid.workbench.script import script

KEPT = 40
"""Fits that a page keeps, so that an undo needs no new fit."""

SOLVING = threading.Lock()
"""One request is computed at a time: the solvers, the fits of a page and the warning filters are shared."""


@dataclass(frozen=True)
class BenchSource:
    """A record, the expression of Python that reads it, and the state a page begins with."""

    data: Data
    expression: str
    start: Mapping[str, Any]
    model: Any = None


@dataclass
class Bench:
    """The fits of one page; no other page can reach them."""

    source: BenchSource
    fits: "OrderedDict[str, tuple[Any, Any]]" = field(default_factory=OrderedDict)
    moving: tuple[str, Any] = ("", None)  # last fit of a band being dragged, by the key without the band

    def answer(self, question: str, asked: Mapping[str, Any]) -> Any:
        """Respond to a request of the page; the response has the reason where a fit is impossible."""
        known: dict[str, Callable[[Mapping[str, Any]], Any]] = {
            "fit": self._fit, "judge": self._judge, "time": self._time, "export": self._export,
            "delay": self._delay, "diagnose": self._diagnose}
        if question not in known:
            raise DataError(f"the page sent an unknown request, {question!r}")
        with SOLVING, warnings.catch_warnings(action="ignore"):  # the findings contain them
            try:
                return known[question](asked)
            except OptidError as error:
                return {"error": str(error)}

    def _found(self, asked: Mapping[str, Any]) -> tuple[Any, Any]:
        return self._kept(Request.parse(asked.get("state"), bool(asked.get("draft"))))

    def _kept(self, request: Request) -> tuple[Any, Any]:
        from optid.show.charts import free_run

        def begin(free: Request) -> Any:
            found = self.moving[1] if request.draft and self.moving[0] == free.key else self._kept(free)[0]
            self.moving = free.key, found
            return found

        if request.key not in self.fits:
            if not request.draft:
                self.moving = "", None
            fit = request.fit(self.source.data, begin)
            self.moving = self.moving[0], fit
            self.fits[request.key] = fit, free_run(fit.model, fit.data.raw())
        self.fits.move_to_end(request.key)
        while len(self.fits) > KEPT:
            self.fits.popitem(last=False)
        return self.fits[request.key]

    def _fit(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        started = time.thread_time()
        fit, run = self._found(asked)
        found = views.quick(fit, run, asked.get("output"))
        return {**found, "time": self._time(asked), "seconds": time.thread_time() - started}

    def _time(self, asked: Mapping[str, Any]) -> list[dict[str, Any]]:
        fit, run = self._found(asked)
        return views.time_chart(fit.data.raw(), run, int(asked.get("experiment", 0)), asked.get("view"))

    def _judge(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        return views.verdict_view(self._found(asked)[0])

    def _delay(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        return views.delay_view(Request.parse(asked.get("state")).record(self.source.data))

    def _export(self, asked: Mapping[str, Any]) -> dict[str, str]:
        from optid.show.report import render

        what = asked.get("what")
        if what == "script":
            request, of = Request.parse(asked.get("state")), self.source
            return {"name": "fit.py", "text": script(request, of.expression, request.whole(of.data))}
        fit = self._found(asked)[0]
        if what == "model":
            with TemporaryDirectory() as folder:
                fit.save(path := Path(folder) / "model.json")
                return {"name": path.name, "text": path.read_text(encoding="utf-8")}
        return {"name": "report.html", "text": render(fit, command="optid workbench")}

    def _diagnose(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        from optid.workbench.diagnosis import diagnose_window

        fit = None if self.source.model is not None else self._found(asked)[0]
        return diagnose_window(self.source.model if fit is None else fit, self.source.data, asked)
