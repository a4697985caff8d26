"""The table: means over seeds, peers against optid on the same seeds, bad data in a word, and the figures asked for."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from records import Row

OURS = ("optid_", "optid_subspace")
MARGIN = 0.1
"""Points of fit below the best peer that still count as equal."""

HANDLED = ("answers", "error that names it", "warns")
"""How a verdict begins when the user gets a good answer or is told what is wrong."""

WORDS = {"one NaN": ("nan", "missing", "finite", "null", "infs"),
         "constant input": ("constant", "excit", "rank", "singular", "variation", "varies"),
         "unstable plant": ("stable", "diverg", "grow", "radius", "pole"),
         "y one shorter": ("shape", "length", "sample", "size", "dimension", "rows", "concatenat")}
"""What a message that names the trouble mentions."""


@dataclass(frozen=True)
class Line:
    """A peer in a row.

    Attributes:
        peer: name of its entry.
        lines: of user code.
        results: what came out, by seed.
        reason: why there is no answer; empty where there is one.
    """

    peer: str
    lines: int
    results: Mapping[int, Mapping] = field(default_factory=dict)
    reason: str = ""

    @property
    def scores(self) -> dict[int, Mapping]:
        """The seeds that gave a model."""
        return {seed: one for seed, one in self.results.items() if "seconds" in one}

    def mean(self, figure: str, seeds=None) -> float:
        """The mean of a figure over its seeds, or over some of them."""
        return float(np.mean([one[figure] for seed, one in self.scores.items() if seeds is None or seed in seeds]))

    @property
    def seconds(self) -> float:
        """The median CPU time of its fits."""
        return float(np.median([one["seconds"] for one in self.scores.values()]))


def line(peer: str, lines: int, results: Mapping[int, Mapping], cannot: str = "") -> Line:
    """A line, with the reason why it is no answer: it cannot, it raised, it was stopped, it breaks a constraint."""
    reason = f"cannot: {cannot}" if cannot else ""
    bad = [one for one in results.values() if "seconds" not in one]
    broken = [one["disobeyed"] for one in results.values() if one.get("disobeyed")]
    if bad:
        first = bad[0]
        text = first.get("stopped") or f"{first['error']}: {first['message']}"
        reason = f"{text} ({len(bad)} of {len(results)} seeds)"
    elif broken:
        reason = f"breaks a constraint ({len(broken)} of {len(results)} seeds): {broken[0]}"
    elif not results and not reason:
        reason = "not run"
    return Line(peer, lines, results, reason)


def difference(ours: Line, peer: Line, figure: str) -> float:
    """Points of fit by which ours is better, the mean over the seeds that both have."""
    seeds = set(ours.scores) & set(peer.scores)
    return ours.mean(figure, seeds) - peer.mean(figure, seeds) if seeds else float("nan")


def rows_text(row: Row, lines: list[Line]) -> list[str]:
    """The lines of a row of the table."""
    ours = [one for one in lines if one.peer in OURS and one.scores]
    text = [f"### {row.title}", "",
            "| peer | lines of user code | CPU time of a fit (s) | one-step fit (%) | simulation fit (%) "
            "| optid better by | seeds |", "|---|---|---|---|---|---|---|"]
    for one in lines:
        if one.peer == OURS[1] and not one.scores:
            continue  # the first entry answers the row
        if not one.scores:
            text.append(f"| {label(one.peer)} | {one.lines or '-'} | {cell(one.reason)} | - | - | - | - |")
            continue
        against = "-" if one.peer in OURS or not ours else " / ".join(
            f"{difference(ours[0], one, figure):+.3f}" for figure in ("one_step", "simulation"))
        remark = f" {cell(one.reason)}" if one.reason else ""
        if any(result.get("later") for result in one.scores.values()):
            remark += f", {one.seconds + one.mean('later'):.3g} with the gain of its noise"
        text.append(f"| {label(one.peer)} | {one.lines} | {one.seconds:.3g}{remark} | {one.mean('one_step'):.3f} | "
                    f"{one.mean('simulation'):.3f} | {against} | {len(one.scores)} |")
    return [*text, ""]


def cell(text: str, length: int = 160) -> str:
    """A text that fits into a cell of a table, without the colours of a terminal."""
    text = " ".join(re.sub(r"\x1b?\[[0-9;]*m", "", text).replace("|", "/").split())
    return text if len(text) <= length else text[: length - 4].rsplit(" ", 1)[0] + " ..."


def label(peer: str) -> str:
    """The name of a peer in the table."""
    return {"optid_": "**optid**", "optid_subspace": "**optid**, subspace", "slicot": "ctrlsys (SLICOT)",
            "jax_sysid_": "jax-sysid", "cvxpy_": "hand-written CVXPY", "casadi_": "hand-written CasADi",
            "python_control": "python-control", "sippy": "SIPPY"}.get(peer, peer.strip("_"))


def verdict(trouble: str, result: Mapping, good: float) -> str:
    """What a peer did with a bad record: one of a few words, and the message where there is one.

    Args:
        trouble: name of the bad record.
        result: what came of it.
        good: its one-step fit on the same record without the trouble.
    """
    if "stopped" in result:
        return f"crash or endless: {result['stopped']}"
    if "error" in result:
        message = f"{result['error']}: {result['message']}"
        named = any(word in message.lower() for word in WORDS[trouble])
        return ("error that names it: " if named else "error: ") + message
    usable = result["one_step"] > {"one NaN": good - 1, "unstable plant": 90.0, "constant input": np.inf,
                                   "y one shorter": good - 1}[trouble]
    if any(word in result["said"].lower() for word in WORDS[trouble]):
        return ("answers, warns: " if usable else "warns: ") + result["said"]
    return "answers" if usable else f"silent nonsense (one-step fit {result['one_step']:.1f} %)"


def equal_task(ours: Mapping[int, Mapping], slicot: Mapping[int, Mapping], title: str) -> str:
    """The subspace step alone: times beside each other, and how far the singular values agree.

    The goal of at most 2 is stated for N = 100,000; a short record shows what a call costs in Python.
    """
    seeds = [seed for seed in ours if "values" in ours[seed] and "values" in slicot.get(seed, {})]
    if not seeds:
        return f"* {title}: the subspace step of ctrlsys or of optid did not run."
    own, other = (float(np.median([found[seed]["seconds"] for seed in seeds])) for found in (ours, slicot))
    apart = 0.0
    for seed in seeds:
        a, b = (np.array(found[seed]["values"]) for found in (ours, slicot))
        apart = max(apart, float(np.max(np.abs(a[: len(b)] - b[: len(a)])) / b[0]))
    return (f"* {title}, the step that both have (statistics, triangular factor, singular values; IB01AD): optid "
            f"{1e3 * own:.3g} ms, ctrlsys {1e3 * other:.3g} ms, {own / other:.2g} times as long; "
            f"singular values equal to {apart:.1e} of the largest.")


def counts(numbers: Mapping[str, int]) -> str:
    """Peers and their numbers, the largest first."""
    return ", ".join(f"{label(peer)} {number}" for peer, number in sorted(numbers.items(), key=lambda item: -item[1]))


def goals(table: Mapping[str, list[Line]], rows: tuple[Row, ...], bad: Mapping[str, Mapping[str, str]] | None = None
          ) -> list[str]:
    """The figures asked for, each with what was reached."""
    text = ["### Against the goals", ""]
    worst, behind = [], []
    for row in rows:
        ours = [one for one in table[row.name] if one.peer in OURS and one.scores]
        peers = [one for one in table[row.name] if one.peer not in OURS and one.scores and not one.reason]
        if not ours or not peers:
            continue
        for figure in ("one_step", "simulation"):
            best = max((difference(one, peer, figure) * -1, label(peer.peer)) for peer in peers for one in ours[:1])
            worst.append(-best[0])
            if -best[0] < -MARGIN:
                behind.append(f"{row.title}, {figure.replace('_', '-')}: {best[1]} by {best[0]:.3f}")
    if worst:
        text.append(f"* Fit within {MARGIN} point of the best peer or above, every row, both fits: "
                    f"{'yes' if not behind else 'no, ' + '; '.join(behind)} (smallest difference {min(worst):+.3f}).")
    answered = {peer: sum(any(one.peer == peer and one.scores and not one.reason for one in table[row.name])
                          for row in rows)
                for peer in dict.fromkeys(one.peer for lines in table.values() for one in lines if one.peer != OURS[1])}
    text.append(f"* Rows answered: {counts(answered)} of {len(rows)}.")
    if bad:
        text.append("* Bad records answered as well as good ones, or the trouble named: " + counts(
            {peer: sum(word.startswith(HANDLED) for word in words.values()) for peer, words in bad.items()})
            + f" of {max(map(len, bad.values()))}.")
    for name in ("long", "long_state_space"):
        lines = {one.peer: one for one in table.get(name, []) if one.scores}
        ours = [lines[peer] for peer in OURS if peer in lines]
        title = next((row.title for row in rows if row.name == name), name)
        if not ours:
            continue
        own = min(one.seconds for one in ours)
        text.append(f"* {title}: CPU time of optid {own:.3g} s; of the others, as multiples of it: " + ", ".join(
            f"{label(one.peer)} {one.seconds / own:.3g}" for one in sorted(
                (one for one in lines.values() if one.peer not in OURS), key=lambda one: one.seconds)) + ".")
        if "slicot" in lines:
            times = own / lines["slicot"].seconds
            text.append(f"  optid takes {times:.3g} times as long as ctrlsys (goal: at most 2).")
    return [*text, ""]
