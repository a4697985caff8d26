"""Parameters of equations that you know: two tanks with square-root outflow. Run: python two_tanks.py."""

import cvxpy as cp

import optid
from optid.examples import example


def torricelli(v):
    """Write the derivative of every state and the value of every output; v has states, inputs and parameters."""
    between, out = v["upper"] * cp.sqrt(v["h1"]), v["lower"] * cp.sqrt(v["h2"])
    return {"h1": v["pump"] * v["u"] - between, "h2": between - out, "y": v["h2"]}


levels = {"h1": (0, None), "h2": (0, None)}  # roots stay defined
plant = optid.Equations(torricelli, states={"h1": 1, "h2": 1}, bounds=levels,
                        parameters={"pump": 1, "upper": 1, "lower": 1})


def main() -> dict[str, float]:
    """Return the parameters, and the change of the level at rest per volt around 1 V."""
    case = example("two_tanks")
    fit = optid.fit(case.data, "physical", equations=plant,
                    constraints=[lambda v: {"larger outlet above": v["upper"] >= v["lower"]}])
    print(fit)
    print("true parameters:", case.truth["parameters"])
    return {**fit.model.parameters, "gain": fit.model.static_gain(1.0)}


if __name__ == "__main__":
    main()
