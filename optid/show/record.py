"""What a record can tell, as a table and as text."""

import numpy as np

from optid.identify.informativity import Informativity
from optid.phrases import p_equals
from optid.show.terminal import set_table, wrap_sentence
from optid.show.wording import Table, number


def informativity_table(told: Informativity) -> Table:
    """Effect, dead time, gain and time constants of every input on every output, in samples."""
    rows = []
    for o, process in enumerate(told.processes):
        for c, (name, response) in enumerate(zip(told.inputs, process.responses)):
            effect = told.effects[o * len(told.inputs) + c] if told.effects else None
            low, high = response.lag_interval
            lag = f"{response.nk}" if low == high else f"{response.nk} ({low} to {high})"
            inside = response.poles[(response.poles != 0) & (response.poles != 1)]
            taus = sorted((-1 / np.log(np.abs(inside))).tolist(), reverse=True)
            seen = f"{'visible' if effect.visible else 'none'} ({p_equals(effect.p_value, 1)})" if effect else "-"
            words = ["integrates"] * response.integrates + [number(tau, 3) for tau in taus]
            rows.append((f"{name} to {process.output}", told.loops[c].word, seen, lag,
                         "-" if response.integrates else number(response.gain, 4), ", ".join(words) or "-"))
    return Table("What the record tells", ("input", "loop", "effect", "first lag", "gain", "time constants"), rows,
                 "Lags and time constants in samples, of a model of low order; in brackets the 95 % interval.")


def describe_informativity(told: Informativity) -> str:
    """Return what a record can tell as text, at most 80 columns wide."""
    lines = [line for sentence in told.findings for line in wrap_sentence(f"- {sentence}")]
    if told.untested:
        lines.append(f"Feedback, effects and dead times were not tested: {told.untested}.")
    if told.processes:
        lines += ["", *set_table(informativity_table(told))] if lines else set_table(informativity_table(told))
    return "\n".join(lines)
