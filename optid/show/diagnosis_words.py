"""Texts of a diagnosis."""

import numpy as np

from optid.data.description import listed_findings
from optid.faults.diagnosis.answers import Diagnosis, Estimate
from optid.faults.kinds import kind_of
from optid.phrases import and_joined, p_value
from optid.show.terminal import wrap_lines

HEADLINES = {
    "healthy": "no alarm",
    "untestable": "the input excites none of the candidates",
    "not isolable": "a fault that cannot be isolated from a single output",
    "unknown": "a fault that is none of the candidates",
}
"""Headline of a verdict without an answer."""


def estimate_line(fault: Estimate) -> str:
    """State the label of a fault, its onset and size."""
    lines = [onset_words(fault), *size_words(fault)]
    if fault.effect:  # of a disturbance of estimated direction on the outputs
        moved = ", ".join(f"{name} by {change:.3g}" for name, change in fault.effect.items())
        lines.append(f"changes {moved} in steady state")
    return "\n".join([fault.label, *("  " + line for line in lines)])


def onset_words(fault: Estimate) -> str:
    """State the onset."""
    (low, high), times = fault.onset_interval, [f" ({time})" if time else "" for time in fault.onset_interval_time]
    if fault.onset_censored:
        before = low == 0
        return f"onset at or {'before' if before else 'after'} sample {high if before else low}{times[before]}"
    if not fault.onset_time:
        return f"onset at sample {fault.onset}" + (f" ({low} to {high})" if low < high else "")
    return f"onset at sample {fault.onset} ({fault.onset_time})" + (f", interval {low} to {high}" if low < high else "")


def size_words(fault: Estimate) -> list[str]:
    """State each magnitude with its interval."""
    lines = []
    for word, value, (low, high) in zip(magnitude_names(fault), fault.size, fault.size_interval):
        if word == "share lost":  # also of a diagnosis that was saved with wider intervals
            value, low, high = (float(np.clip(number, 0.0, 1.0)) for number in (value, low, high))
        if word == "reading":
            lines.append(f"{word} {value:.6g}")
            continue
        interval = f"{low:.3g} to {high:.3g}"
        if not np.isfinite([low, high]).all():
            lines.append(f"{word} unknown")
        elif np.isfinite(value):
            lines.append(f"{word} {value:.3g} ({interval})")
        else:
            lines.append(f"{word} between {low:.3g} and {high:.3g}")
    return lines


def magnitude_names(fault: Estimate) -> list[str]:
    """Return the names of the entries of the size."""
    return kind_of(fault.kind).size_names(fault.name, len(fault.size))


def diagnosis_text(found: Diagnosis) -> str:
    """Print a diagnosis in 80 columns."""
    lines = [
        *listed_findings(found.findings),
        f"{found.verdict}: {headline(found)}",
        f"{window_words(found)}, false alarm {found.false_alarm:g}, p-value {probability_words(found.p_value)}, "
        f"method {found.method}"]
    for answer in found.candidates:
        mark = "  <- best" * (answer is found.best)
        lines += ["", f"probability {answer.posterior:.3f}, gain {answer.gain:.1f}{mark}"]
        lines += [f"  {line}" for line in str(answer).splitlines()]
    if found.detected:
        lines += ["", certificate_words(found)] if found.certificate.basis != "none" else [""]
    if found.remaining is not None:
        lines += [remaining_words(found)]
    lines += [f"untestable: {label}, {why}" for label, why in found.untestable.items()]
    lines += [found.status] * bool(found.status)
    return wrap_lines(lines)


def window_words(found: Diagnosis) -> str:
    """State the length of the record, and when it was taken where that is known."""
    time = found.timeline
    ends = f" from {time.text(0)} to {time.text(found.window - 1)}" if time.dated else ""
    return f"{found.window} samples{ends}"


def headline(found: Diagnosis) -> str:
    """State the result in one clause."""
    if found.verdict in HEADLINES:
        return HEADLINES[found.verdict]
    if found.best is None:
        return f"one of {len(found.candidates)} answers, none of them proved the best"
    if found.unique:
        return found.best.label
    return f"one of {len(found.candidates)} answers, most probably {found.best.label}"


def certificate_words(found: Diagnosis) -> str:
    """State the certificate."""
    proof = found.certificate
    if proof.basis in ("exhaustive", "grid"):
        tried = "every candidate and onset was tried" if proof.basis == "exhaustive" else "a grid of onsets was tried"
        words = f"proof: {tried}; energy explained beyond its threshold {proof.value:.1f}"
        if np.isfinite(proof.runner_up_margin):
            words += f", twice the log-odds against the runner-up {proof.runner_up_margin:.1f}"
        return words
    if proof.basis == "flat line":
        return f"proof: {proof.value:.0f} readings in a row are identical or missing"
    if proof.basis == "duality gap":
        return f"proof: duality gap {proof.value:.1e}"
    if proof.basis == "infeasible healthy":
        return (
            f"proof: no healthy course lies within the bounds of the noise unless they are {proof.value:.3g} times as "
            "wide; the parity vector is kept")
    return "no proof"


def remaining_words(found: Diagnosis) -> str:
    """State the residual."""
    rest = found.remaining
    assert rest is not None
    words = (
        f"left unexplained: energy {rest.energy:.0f} of {rest.readings} readings; the worst of four tests "
        f"({rest.test}) has p-value {probability_words(rest.p_value)}")
    return words if found.verdict != "unknown" else f"{words}; {course_words(found)}"


def course_words(found: Diagnosis) -> str:
    """State direction and frequency of the residual."""
    rest = found.remaining
    assert rest is not None
    names = found.outputs or tuple(f"y{i + 1}" for i in range(len(rest.direction)))
    direction = ", ".join(f"{name} {part:+.2f}" for name, part in zip(names, rest.direction))
    if rest.frequency <= 1 / max(found.window, 1):
        speed = "slow or constant"
    else:
        speed = f"strongest at {rest.frequency:.3g} cycles per sample (period {1 / rest.frequency:.3g} samples)"
    return f"direction {direction}; {speed}, {100 * rest.share:.0f} % of its energy there"


def explanation(found: Diagnosis) -> str:
    """State in three sentences the result, its probability and its evidence."""
    return " ".join(diagnosis_sentences(found))


def diagnosis_sentences(found: Diagnosis, *, notes: bool = True) -> list[str]:
    """State in sentences the result, its probability and its evidence; notes add what was not judged."""
    name = found.model if found.model.startswith("Hammerstein") else found.model[:1].lower() + found.model[1:]
    departs = f"The record departs from the healthy {name} (p-value {probability_words(found.p_value)}), but "
    silent = and_joined(list(found.untestable))
    if found.verdict == "healthy":
        sentences = [
            f"The record of {found.window} samples agrees with the healthy {name}.",
            f"Healthy records depart as far from it with probability {probability_words(found.p_value)}; below "
            f"{found.false_alarm:g} that would be an alarm."]
    elif found.verdict == "untestable" and found.detected:
        sentences = [f"{departs}the input does not excite the candidates: {silent}."]
    elif found.verdict == "untestable":
        sentences = [f"Nothing can be said about {silent}: the input does not excite it."]
    elif found.verdict in ("unknown", "not isolable"):
        why = "no fault of the dictionary fits it." if found.verdict == "unknown" else \
            "with one output a fault of arbitrary course at any place explains it."
        sentences = [departs + why]
        if found.remaining is not None:
            sentences.append(f"Its residual: {course_words(found)}.")
    else:
        sentences = _faulty(found)
    if notes:
        if silent and found.verdict != "untestable":
            sentences.append(f"This record cannot judge {silent}.")
        sentences += [found.status] * bool(found.status)
    return sentences


def _faulty(found: Diagnosis) -> list[str]:
    best, *others = found.candidates
    phrase = " and ".join(
        f"{fault.label} with {onset_words(fault)} and {and_joined(size_words(fault))}" for fault in best.faults)
    most = "most probably " * bool(others)
    first = f"The record is not healthy (p-value {probability_words(found.p_value)}): {most}{phrase}."
    if others:
        shares = and_joined([f"{answer.label} ({answer.posterior:.2f})" for answer in others])
        second = f"At {100 * found.coverage:g} % it (probability {best.posterior:.2f}) is not isolable from {shares}."
    else:
        sure = f"No other candidate remains at {100 * found.coverage:g} %"
        second = f"{sure} (probability {best.posterior:.3f})."
    proof = certificate_words(found)
    return [first, second, proof[0].upper() + proof[1:] + "."]


def probability_words(value: float) -> str:
    """Write a probability."""
    return p_value(value, 2 if value >= 1e-3 else 1, missing="unknown")
