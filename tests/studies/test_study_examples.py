"""The studies that ship: every one is read, runs in reduced size, and shows what its header says."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optid.studies import grid
from optid.studies.study import Study

FOLDER = Path(__file__).parents[2] / "examples" / "studies"
STUDIES = sorted(path.stem for path in FOLDER.glob("*.toml"))
CELLS = {"constraints_under_noise": 1600, "monte_carlo": 7000, "relaxations": 1520}
"""Those whose number does not depend on the solvers that are installed; the headers say it."""


def read(name: str, **changes) -> Study:
    return replace(Study.from_toml(FOLDER / f"{name}.toml"), **changes)


def script(name: str):
    return runpy.run_path(str(FOLDER / f"{name}.py"))["main"]


def fewer(study: Study, **samples: int) -> Study:
    """The same with one length and one noise of each data entry."""
    return replace(study, data=tuple(replace(entry, samples=entry.samples[:1], noise=entry.noise[-1:])
                                     for entry in study.data), **samples)


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_can_be_read_and_says_what_it_shows(name):
    study = read(name)
    header = [line for line in (FOLDER / f"{name}.toml").read_text().splitlines() if line.startswith("#")]
    assert 3 <= len(header) <= 6 and "minutes on two cores" in " ".join(header)
    cells = grid.cells(study)
    if name in CELLS:
        assert len(cells) == CELLS[name] and f"{CELLS[name]:,} cells" in " ".join(header)
    assert Study.from_text(study.to_toml()) == study


@pytest.mark.parametrize("script", sorted(path.name for path in FOLDER.glob("*.py")))
def test_scripts_are_short(script):
    assert len((FOLDER / script).read_text().splitlines()) <= 70


def test_the_built_in_study_solves_everything():
    rows = replace(Study.example(), seeds=1, time_limit=300.0).run(workers=1)
    assert len(rows) == 16 and rows[rows["solver"] == "auto"]["reached"].all()
    assert set(rows["outcome"]) == {"done", "refused"}


def test_constraints_pay_under_noise(tmp_path):
    study = fewer(read("constraints_under_noise"), seeds=6)  # 80 samples, three times as much noise as signal
    error = script("figures")(study, tmp_path / "c.sqlite", ["nonlinearity_error"], workers=1)["nonlinearity_error"]
    assert list(error.columns) == ["free", "monotone", "monotone, odd", "monotone, odd, stable"]
    assert (error["free"] > 1.2 * error["monotone"]).all() and (error["monotone"] > error["monotone, odd"]).all()


def test_relaxations_lie_below_and_the_exact_fit_is_proved(tmp_path):
    study = fewer(read("relaxations"), seeds=4)
    found = script("figures")(study, tmp_path / "r.sqlite", ["gap", "excess", "proved"], workers=1)
    excess = found["excess"]
    assert (excess["exact"] == 0).all() and (excess[["split, plain", "nuclear, no weight"]] < 0).all(axis=None)
    assert found["proved"]["exact"].min() == 1 and found["gap"]["exact"].max() < 1e-6


def test_the_monte_carlo_has_the_figures_of_the_benchmark(tmp_path, capsys):
    from scripts import benchmark

    data = read("monte_carlo").data
    study = read("monte_carlo", seeds=5, data=(replace(data[0], samples=(200,)), replace(data[1], samples=(1000,))))
    found = script("monte_carlo")(study, tmp_path / "m.sqlite", workers=1)
    efficiency = benchmark("efficiency")
    errors, bounds, _ = map(np.array, zip(*(efficiency.run((200, seed)) for seed in range(5))))
    sigma = efficiency.noise_level(efficiency.VALUES)
    expected = np.sqrt(np.mean(np.mean(errors**2, axis=0) / np.mean(bounds, axis=0))) / sigma
    assert found["exact, N = 200"] == pytest.approx(expected, rel=1e-6)
    assert found["split, plain, N = 200"] > found["exact, N = 200"]
    assert 0 < found["cosine, N = 1000"] < 0.03 and "Table 3.1, N = 1000" in capsys.readouterr().out


def test_who_solves_what_is_written_from_the_study(tmp_path):
    whole = read("who_solves_what")
    study = replace(whole, solvers=["clarabel", "osqp", "gauss_newton", "auto"], formulations=tuple(
        entry for entry in whole.formulations if entry.formulation in ("arx", "hammerstein_arx.exact")))
    counts = script("who_solves_what")(study, tmp_path / "w.sqlite", tmp_path / "table.md", workers=1)
    assert counts["unverified"] == 0 and counts["optimal"] >= 12 and counts["problems"] == 5
    text = (tmp_path / "table.md").read_text()
    assert "| `arx` | linear | " in text and "**gauss_newton**" in text and "| osqp | LP QP | 2 | 2 | 2 | 0 |" in text


def test_the_table_in_the_documentation_says_that_nothing_is_unverified():
    text = (FOLDER / "who_solves_what.md").read_text()
    assert '"optimal"; 0 of them without' in text.replace("\n", " ")
    names = {entry.formulation for entry in read("who_solves_what").formulations}
    from optid.registry import FORMULATIONS, find_entry_points

    shipped = {name for name,
               point in find_entry_points(FORMULATIONS).items() if point.value.startswith("formulations.")}
    # physical is for equations of one's own
    assert names == shipped - {"physical"} and all(f"`{name}" in text for name in names)


def test_every_key_and_every_study_is_documented():
    from optid.studies.definition import KEYS, TOP

    text = (FOLDER / "README.md").read_text()
    for keys in (TOP, *KEYS.values()):
        assert all(f"`{key}`" in text or f"[[{key}]]" in text for key in keys)
    assert all(f"`{name}.toml`" in text for name in STUDIES)
    assert all(f"| {count:,} |" in text for count in CELLS.values())
