"""Long work logs what it does, and shows a bar only where somebody looks."""

import logging

import optid
from optid.examples import example
from optid.progress import Meter, track


def test_steps_are_passed_on_and_logged(caplog):
    with caplog.at_level(logging.INFO, "optid"):
        assert list(track(iter("abc"), "letters", 3)) == ["a", "b", "c"]
    assert "letters: 3 of 3 steps" in caplog.text


def test_a_terminal_sees_the_time_that_is_left(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert list(track(range(3), "letters", 3)) == [0, 1, 2]
    with Meter("search", 10.0, lambda: 2.0) as meter:
        meter("2 of 10 units, linear: arx")
    shown = capsys.readouterr().err
    assert "letters" in shown and "linear: arx" in shown


def test_a_fit_and_a_search_are_logged_and_print_nothing(caplog, capsys):
    with caplog.at_level(logging.DEBUG, "optid"):
        optid.identify(example("dead_zone").data, effort=0.5, workers=1, classes=["linear"])
    assert " of 0.5 units, linear: " in caplog.text and "fit arx: " in caplog.text
    assert capsys.readouterr() == ("", "")
