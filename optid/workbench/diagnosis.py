"""A diagnosis for the page: innovations, likelihood of every fault against its onset, and the possible faults."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.errors import StructureError
from optid.show.charts import time_axis
from optid.show.page import coded
from optid.show.sections import Axis, Chart, Series
from optid.workbench.views import SHOWN

TONES = {"healthy": "good", "faulty": "bad"}
MOST = 8
"""Candidates whose energy is drawn: those that explain most."""


def diagnosed(source: Any, data: Data, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Diagnose a window of a record.

    Args:
        source: a state-space model with noise covariances, or a fit of one.
        data: the whole record.
        asked: ``experiment``, ``window``, ``kinds`` of faults, ``without`` (labels removed from the dictionary).
    """
    from optid.faults import diagnose, dictionary
    from optid.faults.diagnosis import words

    model = getattr(source, "model", source)
    if model.structure != "ss" or model.noise is None:
        raise StructureError("a diagnosis needs a state-space model with noise covariances: choose the "
                             "formulation hammerstein_ss.asivid, or start with optid workbench --model model.json")
    kinds = list(asked.get("kinds", ["bias", "loss", "spike"]))
    if not kinds:
        raise StructureError("no kind of fault is chosen: tick one")
    whole = dictionary(model, kinds=kinds)
    without = set(asked.get("without") or ())
    kept = [i for i, label in enumerate(whole.labels) if label not in without]
    if not kept:
        raise StructureError("no fault is left in the dictionary: keep at least one")
    faults = replace(whole, candidates=tuple(whole.candidates[i] for i in kept), sines=whole.sines[np.ix_(kept, kept)])
    whole_record = data.select(list(model.inputs), list(model.outputs), int(asked.get("experiment", 0)))
    first, last = map(int, asked.get("window") or (0, whole_record.n_samples))
    found = diagnose(source, whole_record.window(first, last), faults)
    counted = [f"Onsets are counted from sample {first} of the record."] if first and found.candidates else []
    answers = [[answer.label, f"{answer.posterior:.3f}",
                "; ".join(words.onset_words(f).removeprefix("onset ") for f in answer.faults),
                "; ".join(line for f in answer.faults for line in words.size_words(f))] for answer in found.candidates]
    return {"word": f"{found.verdict}: {words.headline(found)}", "tone": TONES.get(found.verdict, "fair"),
            "sentences": [*words.explained(found, notes=False), *counted],
            "labels": list(whole.labels), "answers": answers,
            "charts": _charts(found, whole_record, first)}


def _charts(found: Any, record: Data, first: int) -> list[dict[str, Any]]:
    seen, x = found.evidence, time_axis(record)
    k = record.experiments[0].start + record.dt * (first + np.arange(len(seen.r), dtype=float))
    charts = []
    for o, name in enumerate(found.outputs or [f"y{o + 1}" for o in range(seen.r.shape[1])]):
        r = np.where(seen.present[:, o], seen.r[:, o], np.nan)
        series = [Series("innovation", k, r, colour="muted", width=1.0)]
        if seen.fitted[:, o].any():
            series.append(Series("best explanation", k, seen.fitted[:, o], colour="c1", width=2.0))
        charts.append(Chart(f"Whitened innovations of {name}", "Mostly between -2 and 2 when healthy.", x,
                            Axis("standard deviations"), series, "fault", height=220))
    if seen.labels:
        peaks = np.nanmax(np.where(np.isnan(seen.gains), -np.inf, seen.gains), axis=1)
        order = [int(i) for i in np.argsort(-peaks)[:MOST] if np.isfinite(peaks[i])]
        series = [Series(seen.labels[i], k, seen.gains[i], colour=f"c{j}", width=1.8) for j, i in enumerate(order)]
        charts.append(Chart("Likelihood of each fault by its onset", "Energy that a fault explains beyond the "
                            "alarm threshold; rarely above zero without a fault.",
                            replace(x, title=x.title.replace("time", "onset").replace("sample", "onset (sample)")),
                            Axis("energy beyond the threshold"), series, "fault", height=320))
    return [coded(one, SHOWN) for one in charts]
