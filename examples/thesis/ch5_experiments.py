"""Section 5.4, experiments 1 to 4: which input recovers the prediction model of the pendulum, order 3.

1 sinusoid, 2 chirp, 3 noise and uniform levels as they are, 4 scaled: channels to unit size (which changes nothing in a
sound fit), and the chirp at twice the amplitude with its envelope divided by the frequency response that experiment 2
measured. Beside: the rules of design, lines of the expanded input and condition number of the expanded regressor.
Run: python ch5_experiments.py
"""

import numpy as np
from ch5_tables import BASES, identified
from common import feedback_error

import optid
from optid import plants
from optid.identify.design.excitation import expanded_condition
from optid.identify.design.rules import check_lines
from optid.statistics.expansion import expand

REFERENCES = {"1 sinusoid": ("0.6/6.4", "0.7/9.5"), "2 chirp": ("6.8/3.5", "0.7/2.5"),
              "3 noise": ("5.6/5.1", "2.8/3.2"), "3 levels": ("8.6/5.7", "3.8/3.4")}


def measured(u: np.ndarray) -> optid.Data:
    """4000 samples for the estimate, then the first 1000 again: validation under the same kind of input."""
    return plants.pendulum(np.concatenate([u, u[:1000]]), 1)


def main() -> dict[str, float]:
    """Return the errors in % of every experiment and method, inf where the record does not determine the model."""
    records = {f"{i} {kind}": measured(plants.pendulum_input(kind, 4000, 1))
               for i, kind in ((1, "sinusoid"), (2, "chirp"), (3, "noise"), (3, "levels"))}
    shaped = optid.design(records["2 chirp"].window(0, 4000), "chirp", band=(0.1, 4), amplitude=(-8, 8), shaped=True)
    records |= {"4 noise, scaled": records["3 noise"].scale(), "4 levels, scaled": records["3 levels"].scale(),
                "4 chirp, scaled and shaped": measured(shaped.u[:, 0]).scale()}
    print(f"{'error of angle / speed in %':<28}{'LSID':>13}{'reference':>10}{'ASIVID':>13}{'reference':>10}"
          f"{'lines':>8}{'condition':>10}")
    found = {}
    for name, data in records.items():
        train, test = data.split(4000)
        expansion = expand(train, "polynomial:4", "polynomial:4")
        rule = check_lines("command", [train.u[:, 0]], expansion.inputs[0], 10)
        found[f"{name} condition"] = condition = expanded_condition(train, expansion, 10)
        line = f"{name:<28}"
        for method, reference in zip(BASES, REFERENCES.get(name, ("", ""))):
            try:
                error = feedback_error(identified(name[2:], method, train, 3), test.raw())
            except optid.errors.RankError:
                error = np.full(2, np.inf)
            text = f"{error[0]:.3g}/{error[1]:.3g}" if np.isfinite(error).all() else "undetermined"
            line += f"{text:>13}{reference:>10}"
            found |= {f"{name} {method} {output}": float(e) for output, e in zip(data.outputs, error)}
        print(line + f"{'few' if rule.severity == 'error' else 'enough':>8}{condition:>10.2g}")
    return found


if __name__ == "__main__":
    main()
