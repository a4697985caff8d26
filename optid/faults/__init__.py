"""Faults: what can break, what the outputs would show of it, who is to blame, and what is left.

The public names are loaded on first use.
"""

from importlib import import_module
from typing import Any

_HOME = {
    "Fault": "faults",
    "inject": "injection",
    "hard_over_test": "hard_over",
    "HardOver": "hard_over",
    "trajectory": "injection",
    "whiten": "whitening",
    "health": "whitening",
    "predictor": "whitening",
    "model_uncertainty": "nuisance",
    "flat_lines": "screening",
    "check_channels": "screening",
    "dictionary": "signatures",
    "Dictionary": "signatures",
    "Candidate": "signatures",
    "Isolability": "isolability",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"optid.faults.{_HOME[name]}"), name)
    raise AttributeError(f"module 'optid.faults' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(_HOME)
