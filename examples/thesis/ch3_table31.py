"""Table 3.1: the trigonometric coefficients of the dead zone; the cosine terms tend to zero, since f is odd.

Its entries are lost; what remains is the pattern. The limits are the least-squares coefficients of the true f.
python ch3_table31.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import BETA, bases, panels, recursion, run, save, with_style

from optid.examples import example

LENGTHS = (1000, 10_000, 100_000)


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return the largest cosine and sine errors for every record length; save the coefficients."""
    basis, found = bases(-1, 1)["trigonometric"], {}
    u = basis.grid(2001)
    names = ["c0", *(f"{letter}{j}" for j in range(1, 6) for letter in "cd")]
    columns = np.column_stack([np.ones(u.size), basis.values(u)])
    limits = np.linalg.lstsq(columns, example("dead_zone", n=100).truth["f"][0](u))[0]
    table = []
    for n in LENGTHS:
        data = example("dead_zone", seed=0, n=n).data
        state = recursion(data, basis)
        state.read(data)
        model = state.model("plain")
        table.append(BETA * np.concatenate([[model.c0], model.nonlinearities[0].mu]))
        cosines, sines = np.r_[table[-1][0], table[-1][1::2]], table[-1][2::2]
        found[f"largest cosine, N = {n}"] = float(np.abs(cosines).max())
        found[f"largest sine error, N = {n}"] = float(np.abs(sines - limits[2::2]).max())
    print("\nTable 3.1, gauge beta = 0.75" + "".join(f"{f'N = {n}':>12}" for n in LENGTHS) + f"{'limit':>12}")
    for name, *values in zip(names, *table, limits):
        print(f"{name:<28}" + "".join(f"{value:12.4f}" for value in values))
    for name, value in found.items():
        print(f"{name:<40}{value:8.4f}")
    figure, ((left, right),) = panels(1, 2)
    left.plot(names, limits, "k_", markersize=14, label="limit")
    left.plot(names, table[0], "o", label=f"N = {LENGTHS[0]}")
    left.set(title="coefficients of the dead zone")
    for kind in ("cosine", "sine error"):
        right.loglog(LENGTHS, [found[f"largest {kind}, N = {n}"] for n in LENGTHS], "o-", label=f"largest {kind}")
    right.loglog(LENGTHS, 0.4 / np.sqrt(LENGTHS), "k--", linewidth=0.8, label=r"$\propto 1/\sqrt{N}$")
    right.set(title="distance from the limit", xlabel="samples N")
    left.legend()
    right.legend()
    save(figure, folder, "ch3_table31.png")
    return found


if __name__ == "__main__":
    run(main)
