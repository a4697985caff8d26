"""Sums and polynomials as text."""

from collections.abc import Iterable


def signed_terms(terms: Iterable[tuple[float, str]], digits: int = 4) -> str:
    """Write " + 1.5 y(k-1) - 0.7" from values and their names, without the terms that are zero."""
    return "".join(
        f" {'-' if value < 0 else '+'} {abs(value):.{digits}g}" + (f" {name}" if name else "")
        for value, name in terms if value
    )


def signed_sum(terms: Iterable[tuple[float, str]], digits: int = 4) -> str:
    """Write "1.5 y(k-1) - 0.7" from values and their names; "0" where all are zero."""
    text = signed_terms(terms, digits)
    return ("-" if text.startswith(" -") else "") + text[3:] or "0"


def polynomial(coefficients: Iterable[float], digits: int = 4) -> str:
    """Write 1 + c_1 q^-1 + c_2 q^-2 + ..., without the terms that are zero."""
    return "1" + signed_terms(((float(c), f"q^-{i}") for i, c in enumerate(coefficients, start=1)), digits)
