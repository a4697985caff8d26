"""What is known about the plant, said as constraints, and what each of them costs.

Three kinds side by side: a shape of the nonlinearity, a static gain, and a CVXPY expression of your own in the named
variables a, b, mu, Theta, offset. The price of a constraint is the points of fit that one unit of relaxation would buy.
"""

import optid
from formulations.constraints import shape
from optid.errors import InfeasibleError
from optid.examples import example


def main() -> dict[str, float]:
    """Return objectives with and without constraints, gain and a_1 of the constrained model, and the prices."""
    record = example("dead_zone", seed=1, n=400)
    structure = {"na": 2, "nb": 2, "basis": "triangular:8"}
    free = optid.fit(record.data, **structure)
    bound = optid.fit(record.data, **structure, constraints=[
        shape.monotone("increasing"),
        shape.gain(9.0, at=0.9),  # output per input in steady state at u = 0.9; the truth is 9.33
        lambda v: {"a1": v["a"][0] <= -1.45},
    ])
    print(bound)
    print(f"\n{'constraint':<24}{'active rows':>12}{'slack':>10}{'points of fit per unit':>26}")
    for price in bound.prices:
        worth = f"{price.fit_points:.3g}" if price.binding else "free"
        print(f"{price.name:<24}{f'{price.active} of {price.rows}':>12}{max(price.slack, 0.0):10.3g}{worth:>26}")
    print(f"objective: free {free.solution.objective:.4f}, constrained {bound.solution.objective:.4f}")
    try:
        optid.fit(record.data, **structure, constraints=[
            shape.monotone("increasing"), shape.stable(radius=0.5), lambda v: {"slow pole": v["a"][0] <= -1.45}])
        explained = ""
    except InfeasibleError as refusal:
        explained = str(refusal)
    print("\nconstraints that contradict each other are named:", explained)
    return {"free": free.solution.objective, "constrained": bound.solution.objective,
            "gain": bound.model.static_gain(0.9), "a1": bound.model.a[0], "proved": float(bound.solution.proof),
            "explained": float("slow pole" in explained and "monotone" not in explained)}


if __name__ == "__main__":
    main()
