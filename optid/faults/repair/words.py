"""A reformulation in words."""

import textwrap
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from optid.faults.repair.reformulation import MemberModel, Reformulation

WIDTH = 80

HEADS = {
    "healthy": "healthy: the plant is as it was",
    "refitted": "one explanation; the model is refitted",
    "as diagnosed": "one explanation; the model is what the diagnosis says",
    "ambiguous": "several explanations; the model stays the healthy one until one is left",
}


def printed(found: "Reformulation") -> str:
    """Say what is left of the plant."""
    lines = [HEADS[found.status]]
    for member in found.members:
        lines.append(f"{member.label} (probability {member.damage.posterior:.3g})")
    if found.schedule is not None:
        lines += str(found.schedule).splitlines()
    if found.if_ambiguous is not None:
        lines += str(found.if_ambiguous).splitlines()
    if found.members:
        lines += str(found.observer).splitlines()
    if found.allocation is not None and found.members:
        lines += str(found.allocation).splitlines()
    told = {line.strip() for line in lines}
    lines += [f"note: {note}" for note in found.notes if note.strip() not in told]
    return "\n".join(wrapped(line) for line in lines)


def wrapped(line: str) -> str:
    """Break a line at 80 columns, what follows indented."""
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    return textwrap.fill(line, WIDTH, subsequent_indent=indent, drop_whitespace=True, break_long_words=False,
                         break_on_hyphens=False)


def member_lines(member: "MemberModel") -> list[str]:
    """Say what is left of the plant if this explanation is right."""
    lines = [member.label]
    if member.schedule is not None:
        lines += str(member.schedule).splitlines()
    lines += str(member.observer).splitlines()
    if member.allocation is not None:
        lines += str(member.allocation).splitlines()
    return lines + [f"note: {note}" for note in member.notes]
