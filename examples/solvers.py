"""The same fit by several back ends, each chosen by one word; every answer is judged by optid's own residuals."""

import optid
from optid.backends import back_ends
from optid.examples import example

KINDS = {"hammerstein_arx.exact": {"rank-one", "NLP"}, "hammerstein_arx.overparametrised": {"QP"}}


def main() -> dict[str, float]:
    """Return the objective of every back end that is installed, and their largest relative disagreement."""
    data, found, disagreement = example("dead_zone", n=400).data, {}, 0.0
    structure = {"na": 2, "nb": 2, "basis": "triangular:6"}
    print(f"{'formulation':<34}{'solver':<14}{'objective':>14}  {'status':<18}{'ms':>8}  stationarity")
    for name, kinds in KINDS.items():
        able = [end.name for end in back_ends().values() if end.installed and kinds.intersection(end.accepted)]
        for word in ["auto", *able]:
            solution = optid.fit(data, name, solver=word, **structure).solution
            found[f"{name} {word}"] = solution.objective
            disagreement = max(disagreement, abs(solution.objective / found[f"{name} auto"] - 1))
            print(f"{name:<34}{word:<14}{solution.objective:14.9f}  {solution.status!s:<18}"
                  f"{1e3 * solution.times.solve:8.1f}  {solution.residuals.stationarity:.0e}")
    print(f"largest relative disagreement: {disagreement:.0e}")
    return {**found, "disagreement": disagreement}


if __name__ == "__main__":
    main()
