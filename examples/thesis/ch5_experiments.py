"""Section 5.4, experiments 1 to 4: which input recovers the prediction model of the pendulum, order 3.

1 sinusoid, 2 chirp, 3 noise (BLWN) and uniform levels (URN) as they are, 4 scaled: channels to unit size (which changes
nothing in a sound fit), and the chirp at twice the amplitude with its envelope divided by the measured frequency
response. Beside: the rules of design. Run: python ch5_experiments.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import judged, run
from drawing import draw_excitations, draw_experiment, draw_frequency_response

import optid
from optid import plants
from optid.identify.design.excitation import expanded_condition
from optid.identify.design.rules import check_lines
from optid.statistics.expansion import expand

REFERENCES = {"1 sinusoid": ("0.6/6.4", "0.7/9.5"), "2 chirp": ("6.8/3.5", "0.7/2.5"),
              "3 noise": ("5.6/5.1", "2.8/3.2"), "3 levels": ("8.6/5.7", "3.8/3.4")}
FIGURES = {"3 noise": "5.8", "3 levels": "5.9", "4 noise, scaled": "5.12", "4 chirp, scaled and shaped": "5.13",
           "4 levels, scaled": "5.14"}


def measured(u: np.ndarray) -> optid.Data:
    """4000 samples for the estimate, then the first 1000 again: validation under the same kind of input."""
    return plants.pendulum(np.concatenate([u, u[:1000]]), 1)


def main(folder: Path) -> dict[str, float]:
    """Return the errors in % of every experiment and method, inf without a model; save figures 5.7 to 5.14."""
    found, records = {}, {f"{i} {kind}": measured(plants.pendulum_input(kind, 4000, 1))
                          for i, kind in ((1, "sinusoid"), (2, "chirp"), (3, "noise"), (3, "levels"))}
    shaped = optid.design(records["2 chirp"].window(0, 4000), "chirp", band=(0.1, 4), amplitude=(-8, 8), shaped=True)
    records |= {"4 noise, scaled": records["3 noise"].scale(), "4 levels, scaled": records["3 levels"].scale(),
                "4 chirp, scaled and shaped": measured(shaped.u[:, 0]).scale()}
    print(f"{'error of angle / speed in %':<28}{'LSID':>13}{'reference':>10}{'ASIVID':>13}{'reference':>10}"
          f"{'lines':>8}{'condition':>10}")
    for name, data in records.items():
        (train, test), fits = data.split(4000), {}
        expansion = expand(train, "polynomial:4", "polynomial:4")
        rule, line = check_lines("command", [train.u[:, 0]], expansion.inputs[0], 10), f"{name:<28}"
        found[f"{name} condition"] = condition = expanded_condition(train, expansion, 10)
        for method, reference in zip(("LSID", "ASIVID"), REFERENCES.get(name, ("", ""))):
            fits[method], error, text = judged(name[2:], method, train, test.raw(), 3)
            line += f"{text:>13}{reference:>10}"
            found |= {f"{name} {method} {output}": float(e) for output, e in zip(data.outputs, error)}
        print(line + f"{'few' if rule.severity == 'error' else 'enough':>8}{condition:>10.2g}")
        if name in FIGURES:
            draw_experiment(folder, FIGURES[name], name, test.raw(), fits)
    draw_excitations(folder, "5.7", 3, records)
    draw_excitations(folder, "5.11", 4, records)
    draw_frequency_response(folder, "5.10", "experiment 2, chirp: frequency response", records["2 chirp"])
    return found


if __name__ == "__main__":
    run(main)
