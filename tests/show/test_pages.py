"""Pages of results in a headless browser: nothing is cut off, nothing overlaps, everything can be read and operated."""

import re

import numpy as np
import pytest
from browser import CHROMIUM, CONTRAST, DREW, NO_BROWSER, OVERLAPS, Browser
from sample_fits import example_fit, feedback_fit, mimo_fit, two_by_two

import optid
from optid import report

COVERED = """[...document.querySelectorAll('h3, .legend button, .zoom button, figcaption')].flatMap((one, i, all) =>
  all.slice(i + 1).filter((other) => { if (!one.offsetParent || !other.offsetParent) return false;
    const a = one.getBoundingClientRect(), b = other.getBoundingClientRect();
    const text = (e, r) => e.tagName === 'H3' ? Object.assign(document.createRange(), {}) && (() => {
      const range = document.createRange(); range.selectNodeContents(e); return range.getBoundingClientRect(); })() : r;
    const p = text(one, a), q = text(other, b);
    return p.left < q.right - 1 && q.left < p.right - 1 && p.top < q.bottom - 1 && q.top < p.bottom - 1; })
  .map((other) => `${one.textContent} | ${other.textContent || other.ariaLabel}`))"""

DRAWN = "[...document.querySelectorAll('[data-chart]')].every((host) => host.querySelector('svg'))"


def dated_fit():
    """A fit of a record of 60 hours, with something to say of it."""
    data = example_fit("thruster").data
    found = optid.Data(data.u, data.y, 360.0, "current", "thrust", start="2024-05-01T06:00")
    return optid.fit(found.map_signals(lambda u: u, lambda y: y, findings=("clock 't': in h, read as seconds",)),
                     "hammerstein_arx.exact", na=2, nb=1, basis="triangular:4")


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Every kind of page, the names of channels awkward."""
    folder = tmp_path_factory.mktemp("pages")
    fit, record = example_fit("thruster"), example_fit("thruster").data
    useless = optid.fit(optid.Data(record.u, np.random.default_rng(0).standard_normal(record.y.shape), record.dt),
                        "arx", na=1, nb=1)
    return {
        "fit": report.write(fit, folder / "fit.html"),
        "several": report.write(mimo_fit(), folder / "several.html", two_by_two(seed=5)),
        "feedback": report.write(feedback_fit(), folder / "feedback.html"),
        "useless": report.write(useless, folder / "useless.html"),
        "validation": fit.validate().report(folder / "validation.html"),
        "comparison": optid.compare_models({"exact": fit.model, "smaller": fit.refit(na=1).model}, record).report(
            folder / "comparison.html"),
        "order": optid.order(record).report(folder / "order.html"),
        "dated": report.write(dated_fit(), folder / "dated.html"),
        "search": optid.identify(record, effort=3, workers=1).report(folder / "search.html")}


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip(NO_BROWSER)
    with Browser(tmp_path_factory.mktemp("profile")) as one:
        yield one


def shown(browser, path, width, dark=False):
    """Open a page and all that is folded, bring every figure into view once; return the seconds of work this was."""
    browser.window(width, 900, dark=dark, phone=width < 500)
    browser.open(path)
    browser.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    browser.run("(async () => { for (const host of document.querySelectorAll('[data-chart]')) { host.scrollIntoView("
                f"{{behavior: 'instant'}}); await {DREW}; }} }})()")
    browser.wait(DRAWN)
    return browser.busy()


NAMES = ["fit", "several", "feedback", "useless", "validation", "comparison", "order", "dated", "search"]


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [1300, 390])
@pytest.mark.parametrize("name", NAMES)
def test_a_page_fits_the_window_and_can_be_read(pages, browser, name, width, dark):
    work = shown(browser, pages[name], width, dark)
    assert browser.complaints() == [] and browser.requests() == []
    assert work < 1
    assert browser.run("document.documentElement.scrollWidth") <= width
    cut = browser.run("[...document.querySelectorAll('.scroll')].filter((e) => e.scrollWidth > e.clientWidth + 1)"
                      ".map((e) => e.ariaLabel)")
    assert cut == []
    assert browser.run(OVERLAPS) == []
    assert browser.run(COVERED) == []
    assert browser.run(CONTRAST) == []


def test_a_useless_model_is_never_green(pages, browser):
    shown(browser, pages["useless"], 1300)
    assert browser.run("document.querySelector('main section.verdict').className") == "verdict bad"
    assert "useless" in browser.run("document.querySelector('main section .word').textContent")


def test_records_zoom_together_and_show_their_values(pages, browser):
    shown(browser, pages["fit"], 1300)
    views = "[...document.querySelectorAll('.charts svg.chart')].map((s) => s.dataset.view)"
    browser.drag(".charts figure:first-child svg.chart", (0.4, 0.4), (0.6, 0.6))
    first, second = browser.run(views)[:2]
    assert first.split()[:2] == second.split()[:2] and float(first.split()[1]) - float(first.split()[0]) < 30
    browser.run("document.querySelector('.charts svg.chart').focus()")
    browser.press(".")
    assert "measured: " in browser.run("document.querySelector('.charts .tip:not([hidden])').textContent")
    browser.press("0")
    again = browser.run(views)[:2]
    assert [view.split()[:2] for view in again] == [again[0].split()[:2]] * 2 and float(again[0].split()[1]) > 55


def test_ticks_of_dates_follow_the_zoom(pages, browser):
    chart = ".charts svg.chart"
    labels = (f"[...document.querySelectorAll('{chart}')].slice(0, 2).map((s) => [...s.querySelectorAll('text')]"
              ".filter((t) => t.getAttribute('text-anchor') === 'middle' && !t.getAttribute('transform'))"
              ".map((t) => t.textContent))")
    for width in (1300, 390):
        shown(browser, pages["dated"], width)
        first = browser.run("document.querySelector('main section').id")
        assert first == "record"
        ticks = browser.run(labels)
        assert "2 May" in ticks[0] and ticks[0][-1].startswith("time, 2024")
        browser.run(f"document.querySelector('{chart}').focus()")
        found = []
        for _ in range(24):
            browser.press("+")
            one, other = browser.run(labels)
            assert one == other  # linked
            assert all(a != b for a, b in zip(one, one[1:])) and browser.run(OVERLAPS) == []
            found.append(one)
        forms = {"".join("0" if sign.isdigit() else sign for sign in tick) for one in found for tick in one[:-1]}
        assert {"00:00", "00:00:00", "00.0 s"} <= forms and not any("e" in form for form in forms - {"0 May"})
        browser.press("0")
        for _ in range(5):
            browser.press("-")
            assert browser.run(OVERLAPS) == []
        assert browser.run(labels)[0][-1] in ("time, 2024", "time")
        browser.press("0")
        browser.press(".")
        tip = browser.run("document.querySelector('.charts .tip:not([hidden])').textContent").splitlines()[0]
        date, sample = re.fullmatch(r"(2024-05-0\d \d\d:\d\d:00), sample (\d+)", tip).groups()
        assert np.datetime64(date) == np.datetime64("2024-05-01T06:00") + int(sample) * np.timedelta64(360, "s")


def test_curves_are_switched_off_by_the_legend(pages, browser):
    shown(browser, pages["fit"], 1300)
    count = "document.querySelectorAll('.charts figure:first-child [data-series]').length"
    before = browser.run(count)
    browser.click(".charts figure:first-child .legend button")
    assert browser.run(count) == before - 1


def test_the_theme_is_switched_by_a_button(pages, browser):
    shown(browser, pages["fit"], 1300)
    light = browser.run("getComputedStyle(document.body).backgroundColor")
    browser.click("#theme")
    assert browser.run("getComputedStyle(document.body).backgroundColor") != light


def test_a_notebook_shows_at_most_one_screen(browser, tmp_path):
    fit = example_fit("thruster")
    horizons = optid.fit_by_horizon(fit.model, fit.data)
    shown_results = {"fit": fit, "several": mimo_fit(), "validation": fit.validate(), "parameters": fit.params,
                     "feedback": feedback_fit(), "model": fit.model, "horizons": horizons}
    browser.window(1000, 900)
    for name, result in shown_results.items():
        page = tmp_path / f"{name}.html"
        page.write_text(f"<!DOCTYPE html><meta charset=utf-8><body>{result._repr_html_()}</body>", encoding="utf-8")
        browser.open(page, ready="document.readyState == 'complete' && document.body")
        assert browser.run("document.body.getBoundingClientRect().height") < 900, name
        assert browser.run("document.querySelectorAll('script').length") == 0


def test_ten_thousand_samples_stay_light_and_quick(browser, tmp_path):
    rng = np.random.default_rng(2)
    u, y = rng.standard_normal(10_000), np.zeros(10_000)
    for k in range(1, u.size):
        y[k] = 0.8 * y[k - 1] + np.tanh(u[k - 1]) + 0.05 * rng.standard_normal()
    fit = optid.fit(optid.Data(u, y, 0.01), na=1, nb=1, nk=1, basis="triangular:10")
    path = report.write(fit, tmp_path / "long.html")
    assert path.stat().st_size < 2e6
    assert shown(browser, path, 1300) < 1
    drawn = browser.run("document.querySelector('.charts path[data-series=measured]').getAttribute('d').length")
    assert drawn < 80_000  # the extremes of every pixel, not every sample
