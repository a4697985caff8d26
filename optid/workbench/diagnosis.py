"""A diagnosis for the page: innovations, likelihood of every fault against its onset, and the possible faults."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.errors import StructureError
from optid.show import diagnosis_words as words
from optid.show.charts import time_axis
from optid.show.diagnosis import TONES, diagnosis_charts
from optid.show.page import encode_chart
from optid.workbench.views import SHOWN


def diagnose_window(source: Any, data: Data, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Diagnose a window of a record by a state-space model with noise covariances, or a fit of one.

    `asked` has ``experiment``, ``window``, ``kinds`` of faults, ``without`` (labels removed from the dictionary).
    """
    from optid.faults import diagnose, dictionary

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
            "sentences": [*words.diagnosis_sentences(found, notes=False), *counted],
            "labels": list(whole.labels), "answers": answers,
            "charts": [encode_chart(one, SHOWN) for one in diagnosis_charts(found, time_axis(whole_record), first)]}
