"""Forms of problems that special methods and proofs know, told by their terms."""

from typing import Any, ClassVar, Self


class Form:
    """A form of problems, with the numbers behind one of them and the names of the unknowns they belong to.

    A back end names the `of` of the form that it takes (`optid.backends.BackEnd`, ``takes``), so that a new form needs
    its class and a back end, and no change here.

    Attributes:
        word: its name in messages and in the list of solvers.
        constrained: whether its methods accept constraints of the user.
    """

    word: ClassVar[str]
    constrained: ClassVar[bool] = False

    @classmethod
    def of(cls, problem: Any) -> Self | None:
        """Return the form of a problem, None where it has another; constraints of the user are not looked at."""
        raise NotImplementedError

    @property
    def about(self) -> str:
        """What the problem is and how large, for the reason of a choice."""
        return self.word
