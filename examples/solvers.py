"""The same fit by several back ends, each chosen by one word; every answer is judged by optid's own residuals."""

import optid
from optid.backends import back_ends
from optid.examples import example

EXACT = ("auto", "gauss_newton", "alternating", "ipopt", "uno")
CONVEX = ("auto", "clarabel", "scs", "osqp", "piqp")


def main() -> dict[str, float]:
    """Return the objective of every back end that is installed."""
    data, found = example("dead_zone", n=400).data, {}
    structure = {"na": 2, "nb": 2, "basis": "triangular:6"}
    installed = {name for name, end in back_ends().items() if end.installed} | {"auto"}
    print(f"{'formulation':<34}{'solver':<14}{'objective':>14}  {'status':<18}{'ms':>8}  stationarity")
    for name, words in (("hammerstein_arx.exact", EXACT), ("hammerstein_arx.overparametrised", CONVEX)):
        for word in words:
            if word not in installed:
                print(f"{name:<34}{word:<14}{'not installed':>14}")
                continue
            solution = optid.fit(data, name, solver=word, **structure).solution
            found[f"{name} {word}"] = solution.objective
            print(f"{name:<34}{word:<14}{solution.objective:14.9f}  {solution.status!s:<18}"
                  f"{1e3 * solution.times.solve:8.1f}  {solution.residuals.stationarity:.0e}")
    return found


if __name__ == "__main__":
    main()
