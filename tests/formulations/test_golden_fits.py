"""Figures of forty fits are as recorded, and a figure that has moved is noticed."""

import json
from copy import deepcopy

import golden_fits
import pytest
from golden_fits import differences, figures, fits, quietly

RECORDED = json.loads(golden_fits.RECORD.read_text())


def test_every_fit_is_recorded():
    assert list(fits()) == list(RECORDED) and len(RECORDED) == 40


@pytest.mark.sampled(20)
@pytest.mark.parametrize("name", RECORDED)
def test_figures_are_as_recorded(name):
    assert not differences(name, figures(quietly(fits()[name][1])), RECORDED[name])


@pytest.mark.parametrize("change, words", [
    (lambda row: row.update(objective=row["objective"] * (1 + 1e-5)), "objective"),
    (lambda row: row.update(objective=float("nan")), "objective"),
    (lambda row: row.update(status="inaccurate"), "status"),
    (lambda row: row.update(verdict="useless"), "verdict"),
    (lambda row: row["prices"].update(gain=[0, *row["prices"]["gain"][1:]]), "active rows"),
    (lambda row: row["prices"].update(gain=[1, 1.01 * row["prices"]["gain"][1], row["prices"]["gain"][2]]),
     "multiplier of gain"),
    (lambda row: row["prices"].pop("gain"), "prices"),
    (lambda row: row["errors"].update(a1=1.01 * row["errors"]["a1"]), "standard error of a1"),
    (lambda row: row["run"].__setitem__(2, row["run"][2] + 0.01), "figure 2 of the free run"),
    (lambda row: row["text"].pop(), "figures in the text"),
    (lambda row: row["text"].__setitem__(0, "123456"), "the text says"),
])
def test_a_figure_that_moves_is_noticed(change, words):
    now = deepcopy(RECORDED["arx gain, sign"])
    assert not differences("arx gain, sign", now, RECORDED["arx gain, sign"])
    change(now)
    (found,) = differences("arx gain, sign", now, RECORDED["arx gain, sign"])
    assert words in found
