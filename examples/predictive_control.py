"""A model as the plant of a predictive controller, in CasADi: its prediction is `simulate`, its input obeys bounds.

The model may be that of a damaged plant (`optid reformulate ... --model damaged.json`): every model has `to_casadi`.

    python examples/predictive_control.py
"""

import casadi as ca
import numpy as np

import optid
from optid.examples import example

HORIZON = 25
LIMIT = 1.4


def controller(model, reference):
    """Return a function from the state to the inputs that follow a reference at least cost."""
    step = model.to_casadi()
    x0, u = ca.MX.sym("x0", step.size1_in(0)), ca.MX.sym("u", HORIZON)
    x, outputs = x0, []
    for k in range(HORIZON):
        x, y = step(x, u[k])
        outputs.append(y)
    predicted = ca.vertcat(*outputs)
    cost = ca.sumsqr(predicted - reference) + 1e-3 * ca.sumsqr(ca.diff(u))
    quiet = {"print_time": 0, "ipopt": {"print_level": 0, "sb": "yes"}}
    solver = ca.nlpsol("mpc", "ipopt", {"x": u, "f": cost, "p": x0}, quiet)
    predict = ca.Function("predict", [x0, u], [predicted])

    def solve(state):
        u = np.array(solver(x0=np.full(HORIZON, 0.3), lbx=-LIMIT, ubx=LIMIT, p=state)["x"])
        return u, np.array(predict(state, u))

    return solve


def main():
    """Follow a step of thrust and compare the controller's prediction with the simulation."""
    chosen = example("thruster")
    model = optid.fit(chosen.data, na=2, nb=1, basis="bspline:6").model
    reference = np.full(HORIZON, 0.8)
    state = np.zeros(model.to_casadi().size1_in(0))
    u, predicted = controller(model, reference)(state)
    difference = float(np.max(np.abs(predicted - model.simulate(u))))
    print(f"inputs between {u.min():.3f} and {u.max():.3f}, at most {LIMIT}")
    print(f"thrust after {HORIZON} samples: {predicted[-1, 0]:.3f}, wanted {reference[-1]:.3f}")
    print(f"prediction against simulation: {difference:.1e}")
    return {"thrust": float(predicted[-1, 0]), "difference": difference}


if __name__ == "__main__":
    main()
