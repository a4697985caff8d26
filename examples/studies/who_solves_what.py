"""Write who_solves_what.md from the study of the same name: python who_solves_what.py [who_solves_what.sqlite]."""

import json
import sys
from datetime import date
from pathlib import Path
from typing import Any

import pandas as pd

import optid
from optid.backends import back_ends
from optid.program.solution import GRADIENT, tolerance

HERE = Path(__file__).with_suffix("")


def unverified(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows that say "optimal" without a proof or with residuals beyond the tolerance of their accuracy.

    A figure that a kink leaves without a value (stationarity) is not beyond it: there the proof alone decides.
    """
    limit = rows["accuracy"].map(tolerance)
    beyond = (rows["complementarity"] > limit) | (rows["stationarity"] > GRADIENT * limit)
    bad = ~rows["proved"] | ~(rows["violation"] <= limit) | beyond
    return rows[(rows["status_verified"] == "optimal") & bad]


def formulations(rows: pd.DataFrame) -> list[str]:
    """Write one line per formulation and record: who solves it, fastest first, and who does not."""
    lines = ["| formulation | record | solved, milliseconds | not solved |", "|---|---|---|---|"]
    for (name, data), group in rows[rows["outcome"] != "refused"].groupby(["formulation", "data"], sort=False):
        good = group[group["reached"]].assign(ms=lambda g: 1e3 * (g["compile_s"].fillna(0) + g["solve_s"]))
        solved = [f"{'**' * r.proved}{r.solver}{'**' * r.proved} {r.ms:.3g}"
                  for r in good.sort_values("ms").itertuples()]
        bad = [f"{r.solver}: {r.status_verified if r.outcome == 'done' else r.outcome}"
               for r in group[~group["reached"]].itertuples()]
        lines.append(f"| `{name}` | {data} | {', '.join(solved)} | {', '.join(bad)} |")
    return lines


def solvers(rows: pd.DataFrame) -> list[str]:
    """Write one line per back end."""
    lines = ["| back end | classes | takes | solves | proved | false claims |", "|---|---|---:|---:|---:|---:|"]
    for name, group in rows.groupby("solver"):
        classes = " ".join(back_ends()[name].accepted) if name in back_ends() else "chooses one of them"
        taken = group[group["outcome"] != "refused"]
        lines.append(f"| {name} | {classes} | {len(taken)} | {taken['reached'].sum()} | {taken['proved'].sum()} | "
                     f"{taken['false_claim'].sum()} |")
    return lines


def main(study: Any, db: Any, target: Path, workers: int | None = None) -> dict[str, int]:
    """Run what is left of the study and write the table; return the number of claims that were not verified."""
    rows = study.run(db, workers=workers)
    counts = {"optimal": int((rows["status_verified"] == "optimal").sum()), "unverified": len(unverified(rows)),
              "false claims": int(rows["false_claim"].sum()), "problems": rows.groupby(["data", "formulation"]).ngroups}
    versions = {k: v for text in rows["versions"] for k, v in json.loads(text).items() if "source" not in k}
    text = (HERE.parent / "who_solves_what.head.md").read_text().format(
        date=date.today(), accuracy=f"{study.accuracy[0]:.0e}", limit=f"{study.time_limit:.0f}", **counts,
        formulations="\n".join(formulations(rows)), solvers="\n".join(solvers(rows)),
        versions=", ".join(f"{k} {v}" for k, v in sorted(versions.items())))
    target.write_text(text, encoding="utf-8")
    print(f"{counts['optimal']} optimal, {counts['unverified']} of them not verified; written to {target}")
    return counts


if __name__ == "__main__":
    database = sys.argv[1] if len(sys.argv) > 1 else HERE.with_suffix(".sqlite").name
    main(optid.Study.from_toml(HERE.with_suffix(".toml")), database, HERE.with_suffix(".md"))
