"""The workbench: its server refuses strangers, fits follow the mouse, and the script repeats the numbers."""

import http.client
import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, CONTRAST, NO_BROWSER, OVERLAPS, Browser
from refusals import refuses
from sample_fits import two_by_two

import optid
from formulations.constraints.poles import disc
from formulations.constraints.responses import step_band
from formulations.constraints.shape import value_range
from optid.errors import DataError, StructureError
from optid.examples import example
from optid.models import HammersteinSS
from optid.workbench import views
from optid.workbench.bench import Bench, BenchSource
from optid.workbench.request import ChosenConstraint, Request, suggest_state
from optid.workbench.server import PAGES, Server, serve

ARGUMENTS = {"na": 2, "nb": 1, "nk": 0, "basis": "triangular:10"}


def source(name="thruster", **options):
    chosen = example(name, **options)
    words = "".join(f", {key}={value!r}" for key, value in options.items())
    return BenchSource(chosen.data, f"optid.examples.example({name!r}{words}).data",
                       suggest_state(chosen.data, chosen.suggestion))


@contextmanager
def served(of):
    server = Server(of)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    with warnings.catch_warnings(action="ignore"):
        try:
            yield server
        finally:
            server.shutdown()
            server.server_close()
            thread.join()


def constrained(state, *constraints):
    return {**state, "constraints": [dict(zip(("word", "arguments", "name"), c)) for c in constraints]}


def asked(server, method="POST", path="/fit", body="{}", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    connection.request(method, path, body if method == "POST" else None, headers)
    answer = connection.getresponse()
    found = answer.status, answer.read().decode(), dict(answer.getheaders())
    connection.close()
    return found


def written(path):
    """Wait for a file and return its text."""
    end = time.monotonic() + 60
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.05)
    return path.read_text()


def test_a_page_begins_with_the_formulation_that_an_example_suggests():
    assert source().start["formulation"] == "hammerstein_arx.exact"
    begun = source("heater")
    shown = Bench(begun).answer("fit", {"state": begun.start})
    assert begun.start["formulation"] == "hammerstein_oe.exact" and shown["word"] == "locally optimal (not proved)"


def test_strangers_are_refused():
    with served(source()) as server:
        first, second = server.open_page(), server.open_page()
        host = {"Host": server.hosts[0]}
        opened = asked(server, "GET", server.address.partition(str(server.server_port))[2], **host)
        assert opened[0] == 200 and "Access-Control-Allow-Origin" not in opened[2]
        assert "connect-src 'self'" in opened[2]["Content-Security-Policy"]
        assert server.server_address[0] == "127.0.0.1"
        body = json.dumps({"state": server.source.start})
        known = {"X-Optid-Page": first}
        assert asked(server, body=body, **host, **known)[0] == 200
        refused = [
            asked(server, "GET", "/", **host), asked(server, "GET", "/?token=wrong", **host),
            asked(server, "GET", f"/?token={server.token}", Host="evil.example"),
            asked(server, "GET", f"/?token={server.token}", Host=f"evil.example:{server.server_port}"),
            asked(server, body=body, **host), asked(server, body=body, **host, **{"X-Optid-Page": server.token}),
            asked(server, body=body, Host="evil.example", **known),
            asked(server, body=body, **host, **known, Origin="http://evil.example"),
            asked(server, body=body, **host, **known, **{"Sec-Fetch-Site": "cross-site"}),
            asked(server, "GET", "/", **host, **{"Sec-Fetch-Site": "cross-site"}),
        ]
        assert [answer[0] for answer in refused] == [403] * len(refused)
        assert server.benches[first].fits and not server.benches[second].fits
        for _ in range(PAGES):
            server.open_page()
        assert asked(server, body=body, **host, **known)[0] == 403  # the oldest page has given way


def test_what_cannot_be_read_or_fitted_is_said():
    with served(source()) as server:
        head = {"Host": server.hosts[0], "X-Optid-Page": server.open_page()}
        assert asked(server, body="[]", **head)[0] == 400
        assert asked(server, body="nonsense", **head)[0] == 400
        assert "cannot be read" in asked(server, body=json.dumps({"state": {"inputs": 3}}), **head)[1]
        assert "unknown request" in asked(server, path="/open", **head)[1]
        empty = constrained(server.source.start, ("range", {"low": 5.0, "high": 6.0}, "high"),
                            ("range", {"low": -6.0, "high": -5.0}, "low"))
        code, text, _ = asked(server, body=json.dumps({"state": empty}), **head)
        assert code == 200 and "high" in json.loads(text)["error"] and "low" in json.loads(text)["error"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("constraints, preparation", [
    ([("monotone", {"direction": "increasing"}, "rising"), ("through", {"u": 0.5, "y": 0.3}, "point 1"),
      ("range", {"low": -0.3, "high": 0.1, "first": -0.5, "last": 0.25}, "corridor 1")],
     {"detrended": True, "dt": 0.2}),
    ([("disc", {"centre": 0.4, "radius": 0.2}, "disc 1"), ("step_band", {"high": 3.3, "last": 15}, "band 1")], {}),
])
def test_the_script_repeats_the_numbers(constraints, preparation):
    of = source()
    bench, state = Bench(of), constrained({**of.start, "window": [20, 520], **preparation}, *constraints)
    shown = bench.answer("fit", {"state": state})
    assert {price["name"] for price in shown["prices"]} == {name for _, _, name in constraints}
    text = bench.answer("export", {"what": "script", "state": state})["text"]
    found = {}
    with warnings.catch_warnings(action="ignore"):
        exec(compile(text.replace("print(fit)", ""), "fit.py", "exec"), found)
    assert found["fit"].solution.objective == shown["objective"]
    kept = list(bench.fits.values())[-1][0]
    assert np.array_equal(found["fit"].model.a, kept.model.a)
    assert json.loads(bench.answer("export", {"what": "model", "state": state})["text"])
    assert "<!DOCTYPE html>" in bench.answer("export", {"what": "page", "state": state})["text"]


def drifting(late=2, slope=0.01):
    """Return a record of the thruster whose output is late and drifts by so much a sample."""
    data = example("thruster").data
    u, y = data.u.ravel(), data.y.ravel()
    return optid.Data(u, np.concatenate([np.full(late, y[0]), y[:y.size - late]]) + slope * np.arange(y.size), data.dt,
                      "current", "thrust")


def test_a_record_is_detrended_and_resampled_in_its_own_units():
    record, flat = drifting(slope=0.01), drifting(slope=0.0)
    state = {**suggest_state(record, {}), "arguments": {"na": 2, "nb": 1, "nk": 2, "basis": "triangular:4"}}
    state = constrained({**state, "detrended": True, "dt": 0.2}, ("through", {"u": 0.5, "y": 3.3}, "point"))
    request = Request.parse(state)
    found, other = request.record(record), request.record(flat)
    assert found.dt == 0.2 and found.n_samples == 300 and found.transform.is_identity
    assert np.ptp(found.y - other.y) < 0.01 < 1 < np.ptp(record.y - flat.y)  # ends of the low-pass
    assert np.mean(found.y) == pytest.approx(np.mean(record.y), abs=0.02)
    assert request.fit(record).model.static_curve(0, np.array([0.5])).item() == pytest.approx(3.3)


def test_a_delay_is_estimated_or_the_reason_given():
    record = drifting(late=3, slope=0.0)
    bench, state = Bench(BenchSource(record, "record", suggest_state(record, {}))), suggest_state(record, {})
    found = bench.answer("delay", {"state": state})
    assert found["nk"] == [3] and "'current' acts from lag 3 on" in found["sentences"]
    still = optid.Data(np.ones(200), record.y[:200], 0.1, "current", "thrust")
    assert "'current'" in Bench(BenchSource(still, "record", state)).answer(
        "delay", {"state": {**state, "window": [0, 200]}})["error"]


def test_every_experiment_is_fitted_as_a_whole():
    record = two_by_two().select(outputs="level_a", inputs="valve <1>")
    state = {**suggest_state(record, {}), "constraints": []}
    bench = Bench(BenchSource(record, "record", state))
    shown = bench.answer("fit", {"state": state})
    assert "experiment 1 of 3" in shown["time"][0]["title"]
    third = bench.answer("time", {"state": state, "experiment": 2})
    assert "experiment 3 of 3" in third[0]["title"]
    assert third[0]["series"][1] != shown["time"][0]["series"][1]
    assert "error" in bench.answer("time", {"state": state, "experiment": 3})
    assert next(iter(bench.fits.values()))[0].figures["candidates"] > record.n_samples - 20
    assert ".window" not in bench.answer("export", {"what": "script", "state": state})["text"]
    cut = bench.answer("export", {"what": "script", "state": {**state, "window": [5, 90]}})["text"]
    assert ".window(5, 90)" in cut


def test_curves_are_drawn_for_the_output_chosen():
    record = two_by_two()
    state = {**suggest_state(record, {}), "formulation": "hammerstein_ss.sivid",
             "arguments": {"nx": 2, "basis": "triangular:5"}, "constraints": []}
    state = constrained(state, ("through", {"u": 0.2, "y": 0.5, "channel": "valve <1>", "output": 'temp "b"'}, "point"))
    bench = Bench(BenchSource(record, "record", state))
    first, second = (bench.answer("fit", {"state": state, "output": name})["charts"][0] for name in record.outputs)
    assert (first["output"], second["output"]) == record.outputs and first["title"] != second["title"]
    assert second["y"]["title"] == 'temp "b" (°C)'
    model = next(iter(bench.fits.values()))[0].model
    assert model.static_curve(0, np.array([0.2]))[:, 1] == pytest.approx(0.5)


def test_requests_are_computed_one_at_a_time(monkeypatch):
    of, running, most = source(), [], []

    def slow(*_):
        running.append(1)
        most.append(len(running))
        time.sleep(0.05)
        running.pop()
        return {}

    monkeypatch.setattr(views, "verdict_view", slow)
    monkeypatch.setattr(views, "quick", slow)
    bench = Bench(of)
    with ThreadPoolExecutor(4) as pool:
        found = [pool.submit(bench.answer, question, {"state": of.start}) for question in ("judge", "fit") * 3]
        assert not any("error" in one.result() for one in found)
    assert max(most) == 1 and len(most) == 6


def test_the_command_serves_until_it_is_interrupted(tmp_path):
    table = np.column_stack([example("thruster").data.u, example("thruster").data.y])
    np.savetxt(tmp_path / "rig.csv", table, delimiter=",", header="u,y", comments="")
    browser, opened = tmp_path / "browser", tmp_path / "opened"
    browser.write_text(f'#!/bin/sh\necho "$@" > {opened}.part && mv {opened}.part {opened}\n')
    browser.chmod(0o755)
    words = ["-m", "optid", "workbench", str(tmp_path / "rig.csv"), "--dt", "0.1"]
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True,
                          env={**os.environ, "BROWSER": str(browser)}) as process:
        assert process.stdout is not None
        said = process.stdout.readline() + process.stdout.readline()
        address = next(word for word in said.split() if word.startswith("http://127.0.0.1:"))
        redirect = Path(written(opened).strip().removeprefix("file://"))
        assert address in redirect.read_text() and redirect.stat().st_mode & 0o777 == 0o600
        assert redirect.parent.stat().st_mode & 0o777 == 0o700
        with urllib.request.urlopen(address, timeout=30) as page:
            text = page.read().decode()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0 and not redirect.exists()
    begin = json.loads(text.partition('id="begin">')[2].partition("</script>")[0])
    assert begin["inputs"] == ["u"] and begin["samples"] == 600 and begin["secret"] not in address


@pytest.mark.filterwarnings("ignore:constraint 'step_band'")  # of the passes before the last
def test_a_corridor_a_disc_and_a_band_hold():
    record = example("thruster").data
    free = optid.fit(record, **ARGUMENTS)
    corridor = optid.fit(record, constraints=[value_range(-0.05, 0.05, first=-0.4, last=0.4)], **ARGUMENTS)
    assert corridor.solution.proof and corridor.prices[0].binding
    inside = np.linspace(-0.4, 0.4, 101)
    f = corridor.model.nonlinearities[0](inside) * corridor.model.b[0].sum() + corridor.model.offset[0]
    assert np.max(np.abs(f)) / (1 + corridor.model.a.sum()) <= 0.05 + 1e-6
    held = optid.fit(record, constraints=[disc(0.3, 0.2)], **ARGUMENTS)
    assert np.max(np.abs(held.model.poles - 0.3)) <= 0.2 and held.solution.proof
    assert np.max(np.abs(free.model.poles - 0.3)) > 0.2
    single = optid.fit(record, constraints=[disc(0.2, 0.3)], **{**ARGUMENTS, "na": 1})
    assert abs(single.model.poles[0] - 0.2) <= 0.3
    band = ChosenConstraint("step_band", {"high": 3.3, "first": 0, "last": 30}, "band")
    request = Request(("current",), ("thrust",), (0, 600), "hammerstein_arx.exact", ARGUMENTS, (band,))
    banded = request.fit(record)
    assert not banded.solution.proof and "tangent" in banded.solution.reason and "not proved" in str(banded)
    model = banded.model
    f = model.nonlinearities[0]
    step = model.step_response(31).ravel() * np.diff(f(np.array(f.basis.interval)))
    assert 3.29 < step.max() < 3.3 * (1 + 1e-3)
    refuses(StructureError, "around=", lambda: optid.fit(record, constraints=[step_band(high=3.3)], **ARGUMENTS))
    with pytest.raises(StructureError, match="outside the interval"):
        optid.fit(record, constraints=[value_range(0, 1, first=5, last=6)], **ARGUMENTS)


def test_a_band_is_exact_without_past_outputs():
    record = example("thruster").data
    fit = optid.fit(record, na=0, nb=12, basis="triangular:6", constraints=[step_band(high=3.0, last=11)])
    f = fit.model.nonlinearities[0]
    step = fit.model.step_response(12).ravel() * np.diff(f(np.array(f.basis.interval)))
    assert step.max() <= 3.0 + 1e-6 and fit.prices[0].binding


def test_a_model_without_an_equilibrium_has_no_static_characteristic(monkeypatch):
    def nowhere(model, c, points):
        raise StructureError("No equilibrium was found.")

    chosen = example("thruster")
    state = {**suggest_state(chosen.data, {}), "formulation": "hammerstein_ss.asivid",
             "arguments": {"nx": 2, "basis": "triangular:5"}}
    for tools in ({"static", "step"}, {"step"}):
        found = Bench(BenchSource(chosen.data, "record", state)).answer("fit", {"state": state})
        assert {chart["tool"] for chart in found["charts"]} & {"static", "step"} == tools
        monkeypatch.setattr(HammersteinSS, "static_curve", nowhere)


def test_faults_may_be_taken_out():
    chosen = example("broken_thruster")
    model = optid.fit(example("thruster").data, "hammerstein_ss.asivid", nx=2, basis="triangular:10").model
    bench = Bench(BenchSource(chosen.data, "", suggest_state(chosen.data, chosen.suggestion), model))
    found, loss = bench.answer("diagnose", {"window": [0, 400]}), "actuator:current loss"
    assert found["word"].startswith("faulty") and found["answers"][0][0] == loss
    less = bench.answer("diagnose", {"window": [0, 400], "without": [loss]})
    assert loss in less["labels"] and all(row[0] != loss for row in less["answers"])
    assert bench.answer("diagnose", {"window": [0, 200]})["word"].startswith("healthy")
    assert "at least one" in bench.answer("diagnose", {"without": found["labels"]})["error"]


@pytest.fixture(scope="module")
def bench_page(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip(NO_BROWSER)
    with served(source()) as server, Browser(tmp_path_factory.mktemp("profile")) as browser:
        yield server, browser


@pytest.fixture
def open_page(tmp_path):
    """A function that opens the page of a source in a browser of its own, and returns that browser."""
    if CHROMIUM is None:
        pytest.skip(NO_BROWSER)
    with ExitStack() as stack:
        def opened(of, width=1300):
            server, browser = stack.enter_context(served(of)), stack.enter_context(Browser(tmp_path / "profile"))
            goto(browser, server, width)
            return browser

        yield opened


def goto(browser, server, width=1300, dark=False):
    browser.window(width, 900, dark=dark, phone=width < 500)
    browser.events.clear()
    browser.send("Page.navigate", url=server.address)
    browser.wait("document.documentElement?.dataset.ready && document.documentElement.dataset.judged")


@contextmanager
def answered(browser):
    """Wait for the fit that is asked for inside."""
    count = browser.run("timings.length")
    yield
    browser.wait(f"timings.length > {count} && !document.documentElement.dataset.busy")


def click(browser, selector):
    with answered(browser):
        browser.click(selector)


def draw(browser, tool, mode, start, end):
    """Choose a tool and drag with the mouse between two places of its plot."""
    host = f"[data-tool={tool}]"
    browser.run(f"document.querySelector('{host}').closest('figure').querySelectorAll('.modes button').forEach("
                f"(b) => b.textContent === '{mode}' && b.setAttribute('id', 'chosen'))")
    browser.click("#chosen")
    browser.run("document.getElementById('chosen').removeAttribute('id')")
    with answered(browser):
        browser.drag(f"{host} svg", start, end)


STATE = "state.constraints.map((c) => c.word)"


@pytest.mark.slow
def test_fits_follow_the_mouse(bench_page):
    server, browser = bench_page
    goto(browser, server)
    before = browser.run("shown.objective")
    draw(browser, "static", "Corridor", (0.4, 0.55), (0.6, 0.7))
    draw(browser, "static", "Point", (0.8, 0.4), (0.8, 0.45))
    draw(browser, "step", "Band", (0.4, 0.9), (0.9, 0.4))
    draw(browser, "poles", "Disc", (0.6, 0.47), (0.75, 0.47))
    assert browser.run(STATE) == ["monotone", "range", "through", "step_band", "disc"]
    assert browser.run("shown.objective") > before
    assert browser.run("document.querySelectorAll('.plot [data-constraint]').length") >= 7
    assert browser.run("[...document.querySelectorAll('.plot text.price')].every((t) => t.textContent)")
    assert not browser.run(OVERLAPS)
    point = browser.run("[state.constraints[2].arguments.u, state.constraints[2].arguments.y]")
    place = browser.run("""(() => { const e = document.querySelector('circle[data-constraint="point 1"]');
        e.scrollIntoView({ block: 'center', behavior: 'instant' }); const r = e.getBoundingClientRect();
        return [r.x + r.width / 2, r.y + r.height / 2]; })()""")
    with answered(browser):
        browser.mouse("mousePressed", *place, button="left", clickCount=1)
        browser.mouse("mouseMoved", place[0] + 8, place[1] - 10, button="left")
        browser.mouse("mouseReleased", place[0] + 8, place[1] - 10, button="left", clickCount=1)
    moved = browser.run("[state.constraints[2].arguments.u, state.constraints[2].arguments.y]")
    assert moved[0] > point[0] and moved[1] > point[1]
    for length in (5, 4, 3, 2, 1):
        click(browser, "#undo")
        assert len(browser.run(STATE)) == length
    assert browser.run("shown.objective") == before and browser.run("document.getElementById('undo').disabled")
    click(browser, "#redo")
    assert browser.run(STATE) == ["monotone", "range"]
    browser.click("#pin")
    click(browser, "#ticks label:nth-child(5)")
    assert browser.run("document.querySelectorAll('#pins tr').length") == 1 and "odd" in browser.run(STATE)
    assert "pin 1" in browser.run("document.getElementById('figures').textContent")
    draw(browser, "time", "Window", (0.3, 0.5), (0.8, 0.5))
    first, last = browser.run("state.window")
    assert 100 < first < 200 and 400 < last < 500
    assert not browser.complaints()
    assert all(url.startswith(f"http://127.0.0.1:{server.server_port}/") for url in browser.requests())


RULES = {"through": {"u": 0.2, "y": 0.5}, "range": {"low": -50, "high": 50, "first": -0.5, "last": 0.5},
         "dead_zone": {"low": -0.1, "high": 0.1}, "step_band": {"last": 10, "low": -99, "high": 99},
         "disc": {"centre": 0, "radius": 0.95}, "monotone": {"direction": "increasing"}, "convex": {}, "concave": {},
         "odd": {}, "even": {}, "saturation": {"low": -0.8, "high": 0.8}, "stable": {"radius": 0.98}}


@pytest.mark.slow
def test_the_page_offers_what_the_formulation_accepts(bench_page):
    server, browser = bench_page
    goto(browser, server)
    tf, ss, both = {"nb": 2, "nk": 0, "basis": "triangular:4"}, {"nx": 2, "basis": "triangular:4"}, [*RULES]
    polynomial = ("arx", "hammerstein_arx.exact", "hammerstein_arx.overparametrised")
    cases = [(name, {**tf, "na": na}, outputs, both) for name in polynomial for outputs in (1, 2) for na in range(4)]
    cases += [(f"hammerstein_ss.{name}", ss, outputs, both) for name in ("sivid", "asivid") for outputs in (1, 2)]
    cases += [("hammerstein_oe.exact", {**tf, "na": 1}, 1, ["step_band", "stable"]),
              ("hammerstein_ss.exact", ss, 1, ["step_band"])]
    record = two_by_two(200).select(inputs="valve <1>")
    for name, arguments, outputs, words in cases:
        arguments = {key: value for key, value in arguments.items() if name != "arx" or key != "basis"}
        data = record.select(outputs=list(record.outputs[:outputs]))
        state = {**suggest_state(data, {}), "formulation": name, "arguments": arguments, "constraints": []}
        browser.run(f"void (state = {json.dumps(state)})")
        bench = Bench(BenchSource(data, "", state))
        for word in words:
            more = {"output": data.outputs[-1]} if outputs > 1 and word in ("through", "range", "step_band") else {}
            found = bench.answer("fit", {"state": constrained(state, (word, {**RULES[word], **more}, word))})
            assert browser.run(f"accepts('{word}')") == ("error" not in found), (name, arguments, outputs, word, found)


def choose(browser, selector, value):
    with answered(browser):
        browser.run(f"(() => {{ const e = document.querySelector('{selector}'); e.value = {json.dumps(value)}; "
                    "e.dispatchEvent(new Event('change')); })()")


TOOLS = "[...document.querySelectorAll('.modes button')].filter((b) => b.checkVisibility()).map((b) => b.textContent)"


@pytest.mark.slow
def test_tools_and_ticks_follow_the_formulation(bench_page):
    server, browser = bench_page
    goto(browser, server)
    assert {"Point", "Corridor", "Flat", "Band", "Disc", "Window"} < set(browser.run(TOOLS))
    draw(browser, "step", "Band", (0.4, 0.9), (0.9, 0.4))
    browser.click("#undo")
    choose(browser, "#field-Formulation", "arx")
    assert set(browser.run(TOOLS)) == {"Zoom", "Point", "Corridor", "Disc", "Window"}
    assert browser.run("document.querySelector('[data-tool=step]').closest('figure')"
                       ".querySelector('.modes [aria-pressed=true]').textContent") == "Zoom"
    assert browser.run("[...document.querySelectorAll('#ticks input:disabled')]"
                       ".map((e) => e.parentElement.textContent)") == ["odd", "even", "saturation"]
    choose(browser, "#field-Formulation", "hammerstein_arx.exact")
    assert "Band" in browser.run(TOOLS) and not browser.complaints()


@pytest.mark.slow
def test_an_empty_number_field_keeps_its_last_value(bench_page):
    server, browser = bench_page
    goto(browser, server)
    draw(browser, "static", "Point", (0.8, 0.4), (0.8, 0.45))
    before, fits = browser.run("JSON.stringify(state)"), browser.run("timings.length")
    for field in ("#last", "#first", "#to", "#constraints .numbers input"):
        value = browser.run(f"document.querySelector('{field}').value")
        for text in ("", "-7.5" if field != "#constraints .numbers input" else ""):
            browser.run(f"(() => {{ const e = document.querySelector('{field}'); e.focus(); e.value = {text!r}; "
                        "e.dispatchEvent(new Event('change')); })()")
            assert browser.run(f"document.querySelector('{field}').value") == value
    assert browser.run("JSON.stringify(state)") == before and browser.run("span") == [0, 600]
    assert browser.run("timings.length") == fits and not browser.complaints()


@pytest.mark.slow
def test_quick_edits_do_not_mix_their_answers(bench_page):
    server, browser = bench_page
    goto(browser, server)
    first = browser.run("document.getElementById('cards').textContent")
    browser.run("change((s) => { s.window = [0, 80]; }); judge(); change((s) => { s.constraints = []; }); judge()")
    browser.wait("!document.documentElement.dataset.busy")
    assert browser.run("document.getElementById('word').matches('.stale')")
    browser.wait("document.documentElement.dataset.judged === JSON.stringify(state)")
    assert not browser.run("document.querySelectorAll('.stale').length")
    assert browser.run("document.getElementById('cards').textContent") != first
    state = browser.run("state")
    judged = Bench(server.source).answer("judge", {"state": state})
    assert browser.run("document.getElementById('sentence').textContent") == judged["sentence"]
    assert browser.run("shown.objective") == Bench(server.source).answer("fit", {"state": state})["objective"]


@pytest.mark.slow
def test_experiment_and_output_are_chosen(open_page):
    record = two_by_two()
    start = {**suggest_state(record, {}), "formulation": "hammerstein_ss.sivid",
             "arguments": {"nx": 2, "basis": "triangular:5"}}
    titles = "[...document.querySelectorAll('#plots figure h3')].map((e) => e.textContent)"
    browser = open_page(BenchSource(record, "", start))
    before = browser.run(titles)
    assert before[0] == "Output level_a, experiment 1 of 3"
    choose(browser, "#field-Experiment", "2")
    choose(browser, "#field-Output-drawn", record.outputs[1])
    after = browser.run(titles)
    assert after == [title.replace("experiment 1", "experiment 3").replace("of level_a", 'of temp "b"')
                     if k != 1 else 'Output temp "b", experiment 3 of 3' for k, title in enumerate(before)]
    draw(browser, "static", "Point", (0.8, 0.4), (0.8, 0.45))
    assert browser.run("state.constraints[0].arguments.output") == record.outputs[1]
    assert browser.run("document.querySelectorAll('.plot circle[data-constraint]').length") == 1
    choose(browser, "#field-Output-drawn", record.outputs[0])
    assert browser.run("document.querySelectorAll('.plot circle[data-constraint]').length") == 0
    assert not browser.run(OVERLAPS) and not browser.run(CONTRAST) and not browser.complaints()


@pytest.mark.slow
def test_a_dated_record_shows_dates_and_samples_of_the_whole(open_page):
    data = example("thruster").data
    data = optid.Data(data.u, data.y, 60.0, "current", "thrust", start="2024-05-01T06:00").map_signals(
        lambda u: u, lambda y: y, findings=("clock 't': in min, read as seconds",))
    start = suggest_state(data, {"na": 2, "nb": 1, "nk": 0, "basis": "triangular:4"})
    start |= {"window": [100, 500], "detrended": True, "dt": 120.0}
    browser = open_page(BenchSource(data, "data", start))
    assert browser.run("document.querySelector('main section').textContent").split("read")[0].endswith("in min, ")
    assert browser.run(OVERLAPS) == []
    browser.run("document.querySelector('#time svg.chart').focus()")
    browser.press(".")
    tip = browser.run("document.querySelector('#time .tip:not([hidden])').textContent").splitlines()[0]
    date, sample = tip.split(", sample ")
    assert int(sample) >= 100
    assert np.datetime64(date) == np.datetime64("2024-05-01T06:00") + int(sample) * np.timedelta64(1, "m")
    ends = browser.run("document.getElementById('dates').textContent").split(" to ")
    assert ends == ["2024-05-01 07:40:00", "2024-05-01 14:19:00"]


@pytest.mark.slow
def test_a_record_is_prepared_by_buttons(open_page):
    record = drifting(late=3)
    y = record.y.copy()
    y[200] += 40  # an outlier, of which the fit warns
    record = optid.Data(record.u, y, record.dt, record.inputs, record.outputs)
    browser = open_page(BenchSource(record, "record", suggest_state(record, {})), 390)
    warning = browser.run("""(() => { const e = document.querySelector("#warnings li"), s = getComputedStyle(e);
        return [e.textContent, parseFloat(s.fontSize), s.color === getComputedStyle(document.body).color]; })()""")
    assert "outlier" in warning[0] and warning[1] > 14 and warning[2]
    for button in ("#detrend", "#resample"):
        click(browser, button)
    assert browser.run("[state.detrended, state.dt]") == [True, 0.2]
    assert browser.run("drawn.get([...drawn.keys()][0]).chart.x.step") == 0.2
    assert browser.run("document.documentElement.scrollWidth") <= 390 and not browser.run(OVERLAPS)
    for left in ([True, None], [False, None]):
        click(browser, "#undo")
        assert browser.run("[!!state.detrended, state.dt ?? null]") == left
    browser.click("#delay")
    browser.wait("state.arguments.nk === 3 && document.querySelector('#delays li')")
    assert not browser.run(CONTRAST) and not browser.complaints()


@pytest.mark.slow
def test_a_browser_follows_the_redirect(tmp_path):
    if CHROMIUM is None:
        pytest.skip(NO_BROWSER)
    with served(source()) as server, Browser(tmp_path / "profile") as browser:
        redirect = server.redirect(tmp_path)
        browser.send("Page.navigate", url=redirect.as_uri())
        browser.wait("document.documentElement?.dataset.ready")
        assert browser.run("location.href") == server.address and not browser.complaints()


@pytest.mark.slow
def test_a_click_saves_a_script_that_repeats_the_page(bench_page, tmp_path):
    server, browser = bench_page
    goto(browser, server)
    draw(browser, "static", "Corridor", (0.4, 0.55), (0.6, 0.7))
    browser.wait("document.documentElement.dataset.judged === JSON.stringify(state)")  # after it nothing moves
    browser.send("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    browser.click("[data-export=script]")
    lines = written(tmp_path / "fit.py") + "print('objective', repr(fit.solution.objective))\n"
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, check=True)
    assert float(done.stdout.split()[-1]) == browser.run("shown.objective")
    assert not browser.complaints()


@pytest.mark.slow
def test_a_page_diagnoses_and_asks_what_if(open_page):
    chosen = example("broken_thruster")
    start = suggest_state(chosen.data, chosen.suggestion)
    start |= {"formulation": "hammerstein_ss.asivid", "arguments": {"nx": 2, "basis": "triangular:10"},
              "window": [0, 240], "constraints": []}
    browser = open_page(BenchSource(chosen.data, "", start))
    browser.click("#diagnose")
    browser.wait("document.documentElement.dataset.diagnosed")
    assert "actuator:current loss" in browser.run("document.querySelector('#found tbody').textContent")
    assert browser.run("document.querySelectorAll('#faultcharts svg.chart').length") == 2
    browser.click("#labels label:nth-child(3)")
    browser.wait("document.documentElement.dataset.diagnosed > 1")
    assert "actuator:current loss" not in browser.run("document.getElementById('found').textContent")
    browser.run("document.getElementById('to').value = ''")
    browser.click("#to")
    browser.write("220")
    browser.press("Tab")
    browser.wait("document.documentElement.dataset.diagnosed > 2")
    assert browser.run("document.querySelector('#found .word').textContent").startswith("healthy")
    assert not browser.run(CONTRAST) and not browser.run(OVERLAPS) and not browser.complaints()


@pytest.mark.slow
@pytest.mark.parametrize("width, dark", [(1300, False), (1300, True), (390, False), (390, True)])
def test_everything_can_be_read(bench_page, width, dark):
    server, browser = bench_page
    goto(browser, server, width, dark)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert not browser.run(OVERLAPS)
    assert not browser.run(CONTRAST)
    assert not browser.run("""[...document.querySelectorAll("figure")].flatMap((figure) => {
        const box = (e) => e.getBoundingClientRect(), zoom = box(figure.querySelector(".zoom"));
        return [...figure.querySelectorAll("h3, .legend button, .modes button")].filter((e) => {
            const b = box(e);
            return b.width && b.bottom > zoom.top && b.top < zoom.bottom && b.right > zoom.left && b.left < zoom.right;
        }).map((e) => e.textContent);
    })""")
    assert not browser.complaints()


def test_ports_that_cannot_be_used_are_named():
    of = source()
    refuses(DataError, "port 70000 of 127.0.0.1 cannot be used: it must be 0 to 65535", serve, of, 70000, print)
    with served(of) as server, pytest.raises(DataError, match=f"port {server.server_port} .* in use"):
        serve(of, server.server_port, print)
