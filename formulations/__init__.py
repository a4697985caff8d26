"""The catalogue of identification problems: one file per problem, each entry returns a Problem or a Procedure."""

from optid.lazy import on_first_use

__getattr__, __dir__ = on_first_use(__name__, {}, {name: f"constraints.{name}" for name in ("shape", "poles",
                                                                                         "responses")})
