"""Finished trials in a file, so that a search that was stopped goes on where it was."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.errors import DataError
from optid.identify.search.trial import OUT_OF_TIME, StructureCandidate, Trial
from optid.models.files import read, write

FORMAT, VERSION = "optid search", 1
ARRAYS = ("energy", "measure")


class KeptTrials:
    """The trials of one search, in memory and in a file if there is one.

    A trial depends on the record, the arguments of the search, and the rival it was tried against; the same one is
    looked for by all of them. One that was cut short by time is not kept.
    """

    def __init__(self, path: str | Path | None, data: Data, settings: Mapping[str, Any]) -> None:
        """Read a file, if there is one; a `DataError` where it belongs to another search or is damaged."""
        self.path = None if path is None else Path(path)
        self.search, self._known = "", dict[str, Trial]()
        if self.path is None:
            return
        self.search = _fingerprint(data, settings)
        if not self.path.exists():
            return
        search, trials = read(self.path, FORMAT, VERSION, lambda content: (content["search"], [
            (row["key"], _trial(row)) for row in content["trials"]]))
        if search != self.search:
            raise DataError(f"{self.path}: its trials are of another record or of other arguments of the search; name "
                            "another file")
        self._known = dict(trials)

    def find_trial(self, candidate: StructureCandidate, rival: Trial | None) -> Trial | None:
        """Return the trial of a candidate against a rival, if it was finished; it takes no more time."""
        found = self._known.get(_key(candidate, rival))
        return None if found is None else replace(found, candidate=candidate, seconds=0.0)

    def keep(self, trials: Sequence[Trial], rival: Trial | None) -> None:
        """Put down finished trials against a rival."""
        self._known |= {_key(one.candidate, rival): one for one in trials if one.reason != OUT_OF_TIME}
        if self.path is not None:
            rows = [{"key": key, **_row(one)} for key, one in self._known.items()]
            write({"search": self.search, "trials": rows}, self.path, FORMAT, VERSION)


def _fingerprint(data: Data, settings: Mapping[str, Any]) -> str:
    found = sha256(repr(sorted((name, str(value)) for name, value in settings.items())).encode())
    for e in data.experiments:
        for samples in (e.u, e.y):
            found.update(np.ascontiguousarray(samples).tobytes())
    return found.hexdigest()


def _key(candidate: StructureCandidate, rival: Trial | None) -> str:
    parts = [candidate] if rival is None else [candidate, rival.candidate]
    return json.dumps([[one.formulation, one.arguments] for one in parts], sort_keys=True, default=str)


def _row(one: Trial) -> dict[str, Any]:
    row = {f.name: getattr(one, f.name) for f in fields(one) if f.name not in ("candidate", *ARRAYS)}
    candidate = one.candidate
    return {**row, **{name: [list(map(str, line)) for line in getattr(one, name).tolist()] for name in ARRAYS},
            "estimation": str(one.estimation), "order": list(one.order), "kind": candidate.kind,
            "formulation": candidate.formulation, "arguments": candidate.arguments}


def _trial(row: dict[str, Any]) -> Trial:
    row = {name: value for name, value in row.items() if name != "key"}
    candidate = StructureCandidate(row.pop("kind"), row.pop("formulation"), row.pop("arguments"))
    width = len(row["energy"][0]) if row["energy"] else 1
    arrays = {name: np.asarray(row.pop(name), dtype=float).reshape(-1, width) for name in ARRAYS}
    return Trial(candidate, **{**row, **arrays, "estimation": float(row["estimation"]), "order": tuple(row["order"])})
