"""The page of a study, in a real browser: quick, quiet, true, and usable by keyboard, on a phone and in the dark."""

import json
import re
import time

import numpy as np
import pytest
from browser import CHROMIUM, NO_BROWSER, Browser
from html_page import Page
from study_rows import rows as synthetic

from optid.errors import DataError
from optid.program.solution import Status
from optid.show.page import embedded
from optid.studies.page import render, write_page
from optid.studies.payload import page_payload
from optid.studies.storage.rows import SUCCESS, columns
from optid.studies.verdicts.outcomes import states_of_rows, tabulate
from optid.studies.verdicts.verdict import conclude

in_browser = pytest.mark.skipif(CHROMIUM is None, reason=NO_BROWSER)
HOSTILE = '</script><script>window.hacked = 1</script><img src=x onerror="window.hacked = 2">"\'&amp;\u2028{{ 7 * 7 }}'
RUNS = 1500


@pytest.fixture(scope="module")
def rows():
    return synthetic(RUNS, 1)


@pytest.fixture(scope="module")
def verdict(rows):
    return conclude(rows)


@pytest.fixture(scope="module")
def page(rows, tmp_path_factory):
    return write_page(rows, tmp_path_factory.mktemp("study") / "study.html")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture
def opened(browser, page):
    """The page, freshly opened in a wide light window."""
    browser.window(1280, 900)
    browser.open(page)
    yield browser
    assert browser.complaints() == [] and browser.requests() == []


# ---- the file


def test_nothing_is_loaded_from_anywhere(page):
    source = page.read_text(encoding="utf-8")
    found = Page(source)
    for attribute in ("src", "href", "xlink:href", "data", "action", "srcset"):
        assert all(value.startswith("#") or value == "data:," for value in found.values(attribute))
    policy = next(v for _, name, v in found.attributes if name == "content" and "default-src" in v)
    assert "default-src 'none'" in policy and "connect-src" not in policy and "'sha256-" in policy
    for word in ("@import", "fetch(", "XMLHttpRequest", "WebSocket", "import(", "localStorage", "innerHTML", "eval("):
        assert word not in source
    assert set(re.findall(r"https?://[^\s\"'<]+", source)) == {"http://www.w3.org/2000/svg"}


def test_identifiers_are_unique_and_every_reference_has_its_target(page):
    found = Page(page.read_text(encoding="utf-8"))
    ids = found.values("id")
    assert len(ids) == len(set(ids))
    assert {value[1:] for value in found.values("href") if value.startswith("#")} <= set(ids)
    scripts = page.read_text(encoding="utf-8").split("<script>")[1]
    asked = set(re.findall(r'byId\("([a-z-]+)"\)', scripts))
    made = set(re.findall(r'id: "([a-z-]+)"', scripts))
    assert asked <= set(ids) | made | {"filter-text"} and len(asked) > 12


def test_the_verdict_stands_without_a_script(page, verdict):
    text = " ".join(Page(page.read_text(encoding="utf-8")).text.split())
    assert verdict.headline.word in text and " ".join(verdict.headline.text.split()) in text
    for statement in verdict.statements:
        assert statement.word in text and " ".join(statement.text.split()) in text
    for claim in verdict.false_claims:
        assert claim.solver in text and claim.reason in text
    assert "optid study report" in text and "synthetic, 2 cores" in text


def test_every_run_is_on_the_page_as_it_is_in_the_database(page, rows, verdict):
    payload = json.loads(re.search(r'id="payload">(.*?)</script>', page.read_text(encoding="utf-8"), re.S)[1])
    assert payload["count"] == len(rows)
    made = {column["name"]: column for column in payload["columns"]}
    for name in ("objective", "n_samples", "iterations", "one_step_fit"):
        for row, shown in zip(rows, made[name]["values"]):
            assert (row[name] is None) == (shown is None)
            assert row[name] is None or shown == pytest.approx(row[name], rel=1e-4)
    for name in ("key", "solver", "reason", "poles", "versions"):
        assert [made[name]["words"][k] for k in made[name]["values"]] == [row[name] or "" for row in rows]
    states = [made["state"]["words"][k] for k in made["state"]["values"]]
    found = tabulate(columns(rows))
    for p in range(0, len(found.data), 7):
        for s in range(len(found.solvers)):
            assert found.row[p, s] < 0 or states[found.row[p, s]] == found.state[p, s]
    for one, two in zip(payload["sections"][0]["standings"], verdict.overall.standings):
        assert (one["solver"], one["solved"], one["problems"]) == (two.solver, two.solved, two.problems)


def test_embedded_values_cannot_end_their_element():
    text = embedded({"a": HOSTILE, "b": "<!--", "c": 1.5})
    assert "<" not in text and "\u2028" not in text
    assert json.loads(text) == {"a": HOSTILE, "b": "<!--", "c": 1.5}
    with pytest.raises(ValueError, match="not JSON compliant"):
        embedded([float("nan")])


def test_huge_texts_are_cut_and_say_so(tmp_path):
    rows = [{**row, "reason": f"{k} " + "x" * 20_000} for k, row in enumerate(synthetic(400, 1))]
    path = write_page(rows, tmp_path / "page.html")
    assert path.stat().st_size < 4e6
    assert "more characters)" in path.read_text(encoding="utf-8")


def test_the_payload_of_long_profiles_keeps_both_ends():
    rng = np.random.default_rng(0)
    made = [{"data": "d", "formulation": "f", "solver": s, "seed": p, "outcome": "done", "status_verified": "optimal",
             "objective": 1.0, "solve_s": float(np.exp(rng.normal())), "scale": 1.0, "violation": 0.0}
            for p in range(2000) for s in "ab"]  # fmt: skip
    verdict = conclude(made)
    xs, ys = page_payload(verdict)["sections"][0]["profiles"]["a"]
    whole = verdict.overall.profiles["a"]
    assert len(xs) <= 400 and xs[0] == 1.0 and ys[-1] == 1.0 and xs[-1] == pytest.approx(whole.factors[-1], rel=1e-4)


def test_what_is_no_study_is_refused_and_nothing_is_written(tmp_path):
    path = tmp_path / "page.html"
    with pytest.raises(DataError):
        write_page([{"solver": "a"}], path)
    assert not path.exists()
    with pytest.raises(OSError):
        write_page(synthetic(20, 1), tmp_path / "no" / "such" / "page.html")


def test_every_word_for_how_a_run_ended_is_explained(verdict):
    words = {state for one in (verdict.overall, *verdict.sections) for s in one.standings for state in s.failures}
    assert {"failed", "false claim", "crashed"} <= words
    explained = set(re.findall(r"<dt>([^<]+)</dt>", render(verdict).split("Words for how a run ended")[1]))
    assert words | {str(status) for status in Status} - set(SUCCESS) | {"refused"} <= explained


def test_title_and_command_are_texts(verdict):
    text = Page(render(verdict, title="<b>mine</b>", command="run --it <now>")).text
    assert "<b>mine</b>" in text and "run --it <now>" in text


# ---- in the browser


def column(browser, number, table="#runs-table"):
    """Texts of one column of a table as shown."""
    script = f"[...document.querySelectorAll('{table} tbody tr')].map(r => r.children[{number}]?.textContent)"
    return browser.run(script)


def shown(browser):
    return browser.run("document.getElementById('runs-count').textContent")


def heading(browser, name, table="#runs-table"):
    buttons = f"[...document.querySelectorAll('{table} thead button')]"
    return browser.run(f"{buttons}.findIndex(b => b.dataset.column === '{name}')")


@in_browser
def test_the_first_glance_has_the_verdict(opened, verdict):
    top = opened.where("#verdict .word")
    opened.run("scrollTo(0, 0)")
    assert opened.run("document.querySelector('#verdict .word').textContent") == verdict.headline.word
    bottom = opened.run("document.querySelector('#verdict .sentence').getBoundingClientRect().bottom")
    assert bottom < 500 and top["width"] > 0
    assert opened.run("document.querySelectorAll('#standings tbody tr').length") == len(verdict.overall.standings)


@in_browser
def test_runs_sort_in_both_directions_with_empty_ones_last(opened, rows):
    at = heading(opened, "objective")
    opened.click("#runs-table [data-column=objective]")
    first = float(column(opened, at)[0])
    assert first == pytest.approx(min(r["objective"] for r in rows if r["objective"] is not None), rel=1e-5)
    head = f"document.querySelectorAll('#runs-table thead th')[{at}]"
    assert opened.run(f"{head}.getAttribute('aria-sort')") == "ascending"
    opened.click("#runs-table [data-column=objective]")
    values = [float(v) for v in column(opened, at)]
    assert values == sorted(values, reverse=True)
    assert values[0] == pytest.approx(max(r["objective"] for r in rows if r["objective"] is not None), rel=1e-5)
    opened.click("#runs-table [aria-label='Last page']")
    assert set(column(opened, at)) == {"-"}
    opened.click("#runs-table [data-column=solver]")
    assert column(opened, heading(opened, "solver"))[0] == min(r["solver"] for r in rows)
    assert opened.run("document.querySelectorAll('#runs-table th[aria-sort]').length") == 1


@in_browser
def test_filters_count_as_the_rows_do(opened, rows):
    """A focus that scrolls would still be scrolling, smoothly, while the next click is on its way."""

    def clear():
        opened.click("#filter-reset")  # what is written before the page has heard the click would be cleared with it
        opened.wait(f"document.getElementById('runs-count').textContent === '{RUNS:,} of {RUNS:,} runs'"
                    " && document.getElementById('filter-text').value === ''")

    def choose(name, word):
        opened.run(f"(() => {{ const s = document.getElementById('filter-{name}'); "
                   f"s.value = [...s.options].find(o => o.text === {json.dumps(word)}).value; "
                   "s.dispatchEvent(new Event('change')); })()")  # fmt: skip

    choose("solver", "scs")
    scs = [row for row in rows if row["solver"] == "scs"]
    assert shown(opened) == f"{len(scs)} of {RUNS:,} runs"
    choose("formulation", "linear")
    some = [row for row in scs if row["formulation"] == "linear"]
    assert shown(opened) == f"{len(some)} of {RUNS:,} runs"
    assert set(column(opened, heading(opened, "solver"))) == {"scs"}
    opened.run("document.getElementById('filter-text').focus({preventScroll: true})")
    opened.write("tanks objective > 0 n_samples=1500")
    exact = [r for r in some if r["data"] == "two tanks" and r["objective"] is not None and r["n_samples"] == 1500]
    opened.wait(f"document.getElementById('runs-count').textContent === '{len(exact)} of {RUNS:,} runs'")
    assert 0 < len(exact) < len(some)
    clear()
    opened.run("document.getElementById('filter-text').focus({preventScroll: true})")
    opened.write("constructor = x")  # no column is called so, and no part of the page is mistaken for one
    opened.wait("document.querySelector('#runs-table tbody').textContent === 'Nothing here.'")
    clear()
    opened.run("document.getElementById('filter-text').focus({preventScroll: true})")
    opened.write("no such words anywhere")
    opened.wait("document.querySelector('#runs-table tbody').textContent === 'Nothing here.'")


@in_browser
def test_a_number_in_the_table_of_failures_lists_its_runs(opened, rows, verdict):
    problems = verdict.overall.standing("scs").failures["false claim"]
    states = states_of_rows(columns(rows), verdict.found)
    count = sum(r["solver"] == "scs" and s == "false claim" for r, s in zip(rows, states))  # repetitions one by one
    opened.click(f"#failure-matrix [aria-label='{problems} false claim, scs: list the runs']")
    assert shown(opened).startswith(f"{count} of ")
    assert set(column(opened, heading(opened, "state"))) == {"false claim"}


@in_browser
def test_pages_turn_and_their_length_changes(opened):
    assert column(opened, 0)[0] == "1" and len(column(opened, 0)) == 50
    opened.click("#runs-table [aria-label='Next page']")
    assert column(opened, 0)[0] == "51"
    assert "Page 2 of 30" in opened.run("document.querySelector('#runs-table .pager').textContent")
    opened.run("(() => { const s = document.querySelector('#runs-table .pager select'); s.value = 250; "
               "s.dispatchEvent(new Event('change')); })()")  # fmt: skip
    assert len(column(opened, 0)) == 250 and column(opened, 0)[0] == "1"
    assert opened.run("document.querySelector('#runs-table [aria-label=\"First page\"]').disabled")


@in_browser
@pytest.mark.parametrize("figure", ["profile", "accuracy", "ranks", "growth"])
def test_figures_zoom_by_dragging_buttons_keys_and_wheel(opened, figure):
    svg = f"#{figure} .plot svg"

    def view():
        text = opened.run(f"document.querySelector('{svg}').dataset.view || ''")
        return [float(v) for v in text.split()]

    assert view() == []
    opened.drag(svg, (0.4, 0.3), (0.7, 0.6))
    near = view()
    opened.click(f"#{figure} .zoom button:nth-child(3)")
    whole = view()
    assert (near[1] - near[0]) / (whole[1] - whole[0]) == pytest.approx(0.35, abs=0.12)
    assert whole[0] < near[0] < near[1] < whole[1]
    opened.click(f"#{figure} .zoom button:nth-child(1)")
    assert view()[1] - view()[0] == pytest.approx(0.6 * (whole[1] - whole[0]), rel=1e-3)
    opened.run(f"document.querySelector('{svg}').focus()")
    opened.press("0")
    assert view() == pytest.approx(whole, rel=1e-4)
    opened.press("+", "ArrowRight")
    moved = view()
    assert moved[1] - moved[0] == pytest.approx(0.6 * (whole[1] - whole[0]), rel=1e-3)
    assert moved[0] + moved[1] > whole[0] + whole[1]
    opened.press("-", "Escape")
    assert view() == pytest.approx(whole, rel=1e-4)
    place = opened.where(svg)
    x, y = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    before = opened.run("scrollY")
    opened.mouse("mouseWheel", x, y, deltaX=0, deltaY=-100, modifiers=2)
    opened.wait(f"document.querySelector('{svg}').dataset.view.split(' ')[1] < {whole[1]} - 1e-6")
    assert opened.run("scrollY") == before


@in_browser
def test_figures_show_what_the_verdict_holds(opened, verdict):
    drawn = opened.run("[...document.querySelectorAll('#profile [data-series]')].map(p => p.dataset.series)")
    assert sorted(drawn) == sorted(s.solver for s in verdict.overall.standings if s.solved)
    heights = opened.run("Object.fromEntries([...document.querySelectorAll('#profile path[data-series]')].map(p => "
                         "[p.dataset.series, Number(p.getAttribute('d').match(/V([\\d.]+)H\\d+$/)[1])]))")  # fmt: skip
    order = sorted(heights, key=heights.get)  # the highest curve has the smallest ordinate
    solved = {s.solver: s.solved for s in verdict.overall.standings}
    assert [solved[name] for name in order] == sorted(solved.values(), reverse=True)
    lines = "[...document.querySelectorAll('#profile details tbody tr')]"
    numbers = opened.run(f"{lines}.map(r => [...r.children].map(c => c.textContent))")
    for name, *cells in numbers:
        for factor, cell in zip((1, 2, 5, 10, 1e99), cells):
            share = 100 * verdict.overall.profiles[name](factor)
            assert float(cell.split()[0]) == pytest.approx(share, rel=6e-3, abs=0.3)


@in_browser
def test_a_solver_is_switched_off_in_every_figure(opened):
    count = "document.querySelectorAll('#figures .plot [data-series=\"scs\"]').length"
    assert opened.run(count) >= 4
    opened.run("[...document.querySelectorAll('#legend button')].find(b => b.title === 'scs').focus()")
    opened.press("Enter")
    assert opened.run(count) == 0
    assert opened.run("document.activeElement.getAttribute('aria-pressed')") == "false"
    opened.press(" ")
    assert opened.run(count) >= 4


@in_browser
def test_the_choice_of_a_formulation_changes_tables_and_figures(opened, verdict):
    section = verdict.sections[0]
    opened.run("(() => { const s = document.getElementById('section'); s.value = 1; "
               "s.dispatchEvent(new Event('change')); })()")  # fmt: skip
    assert opened.run("document.querySelectorAll('#standings tbody tr').length") == len(section.standings)
    assert section.choice.first in opened.run("document.getElementById('said').textContent")
    legend = opened.run("[...document.querySelectorAll('#legend button')].map(b => b.title)")
    assert legend == [s.solver for s in section.standings]
    assert all(name in opened.run("document.getElementById('standings').textContent") for name in section.idle)


# The middle of a cross among the points.
CROSS = """(() => {
  const s = document.querySelector('#accuracy .plot svg'), r = s.getBoundingClientRect();
  const paths = [...s.querySelectorAll('path[data-series]')].map((p) => p.getAttribute('d'));
  const d = paths.sort((a, b) => a.length - b.length)[0], k = r.width / s.viewBox.baseVal.width;
  const [x, y] = d.match(/-?[\\d.]+/g).map(Number);
  return [r.x + (x + 3) * k, r.y + (y + 3) * k];
})()"""


@in_browser
def test_a_point_and_a_run_open_their_details_and_escape_closes_them(opened, rows):
    opened.run("document.querySelector('#runs-table tbody button').focus()")
    opened.press("Enter")
    assert opened.run("document.getElementById('detail').open")
    text = opened.run("document.getElementById('detail').textContent")
    assert rows[0]["key"] in text and rows[0]["reason"] in text and "SHA-256" in text
    opened.press("Escape")
    assert not opened.run("document.getElementById('detail').open")
    assert opened.run("document.activeElement.textContent") == "1"
    opened.where("#accuracy .plot svg")
    place = opened.run(CROSS)
    tip = "document.querySelector('#accuracy .tip').textContent"
    for k in range(100):  # a browser drops moves while it is busy; a hand goes on moving
        opened.mouse("mouseMoved", place[0] + k % 2, place[1])
        if opened.run(tip):
            break
        time.sleep(0.05)
    assert "residual" in opened.run(tip)
    opened.mouse("mousePressed", *place, button="left", clickCount=1)
    opened.mouse("mouseReleased", *place, button="left", clickCount=1)
    opened.wait("document.getElementById('detail').open")
    opened.click("#detail .close")
    assert not opened.run("document.getElementById('detail').open")


@in_browser
def test_the_whole_page_is_reached_by_tab_and_works_by_keyboard(opened):
    opened.run("document.querySelectorAll('details').forEach(d => d.open = false)")
    seen = set()
    for _ in range(90):
        opened.press("Tab")
        seen.add(opened.run("document.activeElement.closest('section, nav, .scope')?.id || 'body'"))
    assert {"verdict", "solvers", "figures", "failures"} <= seen
    visible = opened.run("getComputedStyle(document.activeElement).outlineStyle")
    assert visible != "none"
    opened.run("document.querySelector('#runs-table [data-column=seed]').focus()")
    opened.press("Enter")
    assert opened.run("document.activeElement.closest('th').getAttribute('aria-sort')") == "ascending"
    assert opened.run("document.activeElement.dataset.column") == "seed"


@in_browser
def test_everything_that_acts_has_an_accessible_name(opened):
    opened.send("Accessibility.enable")
    nodes = opened.send("Accessibility.getFullAXTree")["nodes"]
    acting = [n for n in nodes if not n.get("ignored") and n.get("role", {}).get("value") in
              ("button", "link", "combobox", "checkbox", "searchbox", "image", "region", "dialog")]  # fmt: skip
    nameless = [n["role"]["value"] for n in acting if not n.get("name", {}).get("value")]
    assert len(acting) > 100 and nameless == []
    assert opened.run("[...document.querySelectorAll('[role=group]')].every(e => e.getAttribute('aria-label'))")
    pictures = [n["name"]["value"] for n in acting if n["role"]["value"] == "image"]
    assert any(name.startswith("Performance profile") for name in pictures)


@in_browser
def test_light_dark_and_the_switch(browser, page, tmp_path):
    import matplotlib.image

    def brightness(name):
        return float(np.median(matplotlib.image.imread(browser.picture(tmp_path / f"{name}.png"))[..., :3]))

    browser.window(1280, 900)
    browser.open(page)
    assert brightness("light") > 0.85
    browser.click("#theme")
    assert brightness("switched") < 0.3
    assert browser.run("document.getElementById('theme').getAttribute('aria-label')") == "Switch to light colours"
    browser.window(1280, 900, dark=True)
    browser.open(page)
    assert brightness("dark") < 0.3
    browser.click("#theme")
    assert brightness("back") > 0.85
    assert browser.complaints() == [] and browser.requests() == []


# Every visible text: its contrast with its ground, transparent colours laid over each other, relative to what WCAG asks
# for: 4.5, of large texts (24 px, or 18.66 px and bold) 3.
CONTRAST = """(() => {
  const k = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const linear = (v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const light = (layers) => { k.fillStyle = '#fff'; k.fillRect(0, 0, 1, 1);
    for (const c of layers) { k.fillStyle = c; k.fillRect(0, 0, 1, 1); }
    const [r, g, b] = [...k.getImageData(0, 0, 1, 1).data].map(linear);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const grounds = (e) => { const found = [];
    for (; e; e = e.parentElement) found.unshift(getComputedStyle(e).backgroundColor);
    return found; };
  document.querySelectorAll('details').forEach((d) => { d.open = true; });
  return [...document.querySelectorAll('body *')].filter((e) => !e.closest('svg') && !e.disabled &&
    [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim()) && e.checkVisibility())
    .map((e) => { const s = getComputedStyle(e), a = light([...grounds(e), s.color]), b = light(grounds(e));
      const size = parseFloat(s.fontSize), large = size >= 24 || (size >= 18.66 && s.fontWeight >= 700);
      return [(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) / (large ? 3 : 4.5),
              `${e.closest('section')?.id} ${e.className}: ${e.textContent.slice(0, 30)}`]; })
    .sort((x, y) => x[0] - y[0]); })()"""


@in_browser
@pytest.mark.parametrize("dark", [False, True])
def test_texts_stand_out_from_their_ground(browser, page, dark):
    browser.window(1280, 900, dark=dark)
    browser.open(page)
    found = browser.run(CONTRAST)
    assert found[0][0] >= 1.0, found[:3]
    assert {"verdict", "solvers", "failures", "agreement", "models", "runs"} <= {what.split()[0] for _, what in found}


@in_browser
def test_no_reason_is_cut_off(browser, tmp_path):
    """What has no other place on the page, such as a title that neither keys nor fingers reach, is shown in full."""
    reason = "the point is not stationary: " + "residual 1e-3, complementarity 2e-4, " * 8
    rows = [{**row, "reason": reason if row["reason"] else None} for row in synthetic(300, 1)]
    browser.window(1000, 800)
    browser.open(write_page(rows, tmp_path / "page.html"))
    browser.run("document.querySelectorAll('details').forEach(d => d.open = true)")
    cells = "[...document.querySelectorAll('#failures > .scroll td, #reasons td')]"
    texts = browser.run(f"{cells}.map(c => c.textContent)")
    assert sum(reason.strip() in text for text in texts) >= 2
    assert browser.run(f"{cells}.every(c => c.scrollWidth <= c.clientWidth + 1)")
    hints = browser.run("document.querySelector('#standings details').innerText")
    assert "failures at limit" in hints and "every failure counted as the time limit" in hints


@in_browser
def test_two_lengths_are_drawn_without_a_slope_and_their_axis_is_clear(browser, tmp_path):
    rows = [row for row in synthetic(1500, 1) if row["n_samples"] in (200, 5000)]
    browser.window(1280, 900)
    browser.open(write_page(rows, tmp_path / "page.html"))
    caption = browser.run("document.querySelector('#growth figcaption').textContent")
    assert "slope cannot be told: it needs at least 3 record lengths" in caption and "grows as" not in caption
    assert browser.run("document.querySelectorAll('#growth [data-series]').length") > 0
    free = """[...document.querySelectorAll('#growth .plot, #accuracy .plot')].every((plot) => {
      const texts = [...plot.querySelectorAll('svg text')], title = texts.find((t) => t.hasAttribute('transform'));
      return texts.filter((t) => t.getAttribute('text-anchor') === 'end' && !t.closest('g')).every(
        (t) => t.getBoundingClientRect().left >= title.getBoundingClientRect().right); })"""
    assert browser.run(free)


@in_browser
def test_the_tables_of_a_wide_window_are_not_cut(browser, page):
    browser.window(1400, 900)
    browser.open(page)
    for table in ("standings", "runs-table"):
        region = f"document.querySelector('#{table} .grid')"
        assert browser.run(f"{region}.scrollWidth <= {region}.clientWidth + 1"), table


@in_browser
@pytest.mark.parametrize("width", [320, 390, 768])
def test_a_phone_needs_no_sideways_scrolling(browser, page, width):
    browser.window(width, 800, phone=True)
    browser.open(page)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run("document.getElementById('profile').getBoundingClientRect().right") <= width
    inside = "e => e.getBoundingClientRect().right <= innerWidth"
    assert browser.run(f"[...document.querySelectorAll('.picks .why')].every({inside})")
    assert browser.complaints() == [] and browser.requests() == []


@in_browser
def test_the_csv_holds_the_filtered_runs_and_no_formulas(browser, tmp_path):
    rows = synthetic(60, 1)
    rows[3] = {**rows[3], "data": "=1+1", "machine": 'a "quoted" machine'}
    browser.open(write_page(rows, tmp_path / "page.html"))
    browser.run("(() => { window.saved = null; URL.createObjectURL = (blob) => { window.saved = blob; return '#'; };"
                "HTMLAnchorElement.prototype.click = function () {}; })()")  # fmt: skip
    browser.click("#download")
    text = browser.run("window.saved.text()")
    import csv
    import io

    read = list(csv.DictReader(io.StringIO(text)))
    assert len(read) == 60 and read[3]["data"] == "'=1+1" and read[3]["machine"] == 'a "quoted" machine'
    assert [r["solver"] for r in read] == [r["solver"] for r in rows]


# ---- bad input


def bad_inputs():
    good = synthetic(120, 1)
    failed = [{**r, "outcome": "error", "status_verified": None, "objective": None, "false_claim": False} for r in good]
    solved = {"outcome": "done", "status_verified": "optimal", "false_claim": False, "objective": 1.0, "solve_s": 0.1}
    nan = dict.fromkeys(("objective", "solve_s", "noise"), float("nan"))
    nan |= {"violation": float("inf"), "gap": -float("inf")}
    text = ("study", "data", "formulation", "solver", "reason", "machine", "status_claimed", "options", "poles",
            "versions")  # fmt: skip
    odd = ("__proto__", "constructor", "toString", "")
    huge = {"data": "d" * 5000, "reason": "r" * 100_000}
    many = [{**good[k % 120], **solved, "solver": f"solver {k % 40}", "seed": k // 40} for k in range(400)]
    return {
        "empty": [],
        "one row": good[3:4],
        "one solver": [r for r in good if r["solver"] == "ipopt"],
        "one data set": [r for r in synthetic(300, 1) if r["data"] == "heater"],
        "all failed": failed,
        "all refused": [{**r, "outcome": "refused", "status_verified": None, "objective": None} for r in good],
        "unknown truth": [{**r, "parameter_error": None, "nonlinearity_error": None} for r in good],
        "not finite": [{**r, **nan} for r in good],
        "hostile names": [{**r, **{c: HOSTILE + str(r[c]) for c in text}} for r in good],
        "prototype names": [{**r, "solver": odd[k % 4]} for k, r in enumerate(good)],
        "huge texts": [{**r, **huge, "solver": r["solver"] + "s" * 3000} for r in good],
        "surrogates": [{**r, "data": "\ud800 lone", "solver": r["solver"] + " \U0001f600 \u202e"} for r in good],
        "forty solvers": many,
        "equal times": [{**r, **solved} for r in good],
        "zero and negative times": [{**r, **solved, "solve_s": (0.0, -1.0)[k % 2]} for k, r in enumerate(good)],
        "negative objectives": [{**r, "objective": -1.0 if r["objective"] else None} for r in good],
        "zero residuals": [{**r, **solved, "violation": 0.0, "stationarity": 0.0} for r in good],
    }


@pytest.mark.sampled(2)
@in_browser
@pytest.mark.parametrize("name", bad_inputs())
def test_bad_input_gives_a_true_and_quiet_page(browser, tmp_path, name):
    rows = bad_inputs()[name]
    path = write_page(rows, tmp_path / "page.html")
    browser.window(1000, 800)
    browser.open(path)
    assert browser.complaints() == [] and browser.requests() == []
    assert browser.run("window.hacked === undefined")
    assert browser.run("document.documentElement.scrollWidth") <= 1000
    assert browser.run("document.querySelectorAll('section').length") == 8
    word = browser.run("document.querySelector('#verdict .word').textContent")
    assert word == conclude(rows).headline.word or name == "surrogates"
    text = browser.run("document.body.innerText")
    for wrong in ("NaN", "Infinity", "undefined", "[object"):
        assert wrong not in text.replace(HOSTILE, ""), wrong
    if rows:
        assert f"of {len(rows)} run" in shown(browser)
    for act in ("#runs-table thead button", "#filter-reset", "#profile .zoom button"):
        if browser.run(f"!!document.querySelector('{act}')"):
            browser.click(act)
    assert browser.complaints() == []


def test_bad_input_is_told_in_words():
    verdicts = {name: conclude(rows) for name, rows in bad_inputs().items()}
    words = {name: verdict.headline.word for name, verdict in verdicts.items()}
    assert words["empty"] == "Nothing to compare" and words["all refused"] == "Nothing was run"
    assert words["all failed"] == words["not finite"] == "No solver can be recommended"
    assert words["one row"] == "Only one solver" and words["one solver"] == "Models: cannot tell yet"
    assert "data sets; there is 1" in str(verdicts["one data set"])
    assert "Truth unknown" in str(verdicts["unknown truth"])
    for name in ("empty", "all failed", "all refused", "not finite", "one solver", "one row"):
        assert verdicts[name].recommended == ()
    assert max(len(s.text) for s in (verdicts["huge texts"].headline, *verdicts["huge texts"].statements)) < 1500
    assert words["equal times"].startswith("A tie")
