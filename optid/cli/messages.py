"""Messages of the command line: options in place of arguments of Python."""

import re

from optid.descriptions import describe
from optid.registry import FORMULATIONS, registered


def option_of(argument: str) -> str:
    """Return the option word of an argument."""
    return "--" + argument.replace("_", "-")


def in_options(text: str) -> str:
    """Write a message about arguments of Python with the options of the command."""
    known = {"solver", "accuracy", "time_limit"}
    for point in registered(FORMULATIONS).values():
        try:
            known |= describe(point).options.keys()
        except ImportError:
            continue
    word = "|".join(sorted(known, key=len, reverse=True))

    def several(match: re.Match[str]) -> str:
        return match[1] + ", ".join(option_of(one) for one in match[2].split(", ") if one != "constraints")

    text = re.sub(rf"(takes no )argument '({word})'(?=\.)", lambda m: m[1] + option_of(m[2]), text)
    text = re.sub(rf"( needs |Known: )((?:{word})(?:, (?:{word}))*)(?=$|\.)", several, text)
    text = re.sub(rf"(?<![\w.-])({word})=(?=['\w\[(.-])", lambda m: option_of(m[1]) + " ", text)
    return re.sub(rf"^({word})(?=,| must| is )", lambda m: option_of(m[1]), text)
