import re
import warnings
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import CHROMIUM, NO_BROWSER, look
from sample_fits import example_fit, feedback_fit, linear_fit, mimo_fit, two_by_two

import optid
from optid import report


class Page(HTMLParser):
    """Elements, attributes and visible text of a page; refuses tags that are not closed in order."""

    VOID = {"meta", "link", "br", "img", "hr", "input"}

    def __init__(self, source: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.text = ""
        self.feed(source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "title"):
            self.text += data

    def values(self, name: str) -> list[str]:
        return [value for _, attribute, value in self.attributes if attribute == name]


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {
        "thruster": report.render(example_fit("thruster")),
        "mimo": report.render(mimo_fit(), two_by_two(seed=5)),
        "linear": report.render(linear_fit()),
        "feedback": report.render(feedback_fit()),
    }


@pytest.mark.parametrize("name", ["thruster", "mimo", "linear", "feedback"])
def test_nothing_is_loaded_from_anywhere(pages, name):
    page = Page(pages[name])
    for attribute in ("src", "href", "xlink:href", "data", "action", "srcset"):
        assert all(value.startswith("#") or value == "data:," for value in page.values(attribute))
    assert not re.search(r"url\((?!#)", pages[name])
    assert "@import" not in pages[name] and "<script" not in pages[name] and "http://" not in pages[name]
    assert "https://" not in pages[name]


@pytest.mark.parametrize("name", ["thruster", "mimo", "linear", "feedback"])
def test_identifiers_are_unique_and_every_reference_has_its_target(pages, name):
    page = Page(pages[name])
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    targets = [value[1:] for value in page.values("href") if value.startswith("#")]
    targets += re.findall(r"url\(#([^)]+)\)", pages[name])
    assert set(targets) <= set(ids) and len(targets) > 20


def test_the_verdict_the_figures_and_the_prices_are_on_the_page(pages):
    fit, page = example_fit("thruster"), Page(pages["thruster"])
    text = page.text.replace("\N{NO-BREAK SPACE}", " ")
    for words in (
        "Optimal (proved)",
        f"{fit.one_step_fit[0]:.2f} %",
        f"{fit.simulation_fit[0]:.2f} %",
        "monotone:increasing",
        fit.model.equation(),
        "optid.fit(data, 'hammerstein_arx.exact', na=2",
        optid.__version__,
        str(fit),
    ):
        assert words in text
    sections = {value for tag, name, value in page.attributes if tag == "section" and name == "id"}
    assert sections == {
        "verdict",
        "trust",
        "model",
        "figures",
        "constraints",
        "certificate",
        "validation",
        "data",
        "solver",
        "reproduce",
    }
    assert pages["thruster"].count("<figure>") == pages["thruster"].count("<svg ") == 5


@pytest.mark.slow
def test_names_are_text_never_markup():
    data = two_by_two()
    hostile = optid.Data(
        data.u, data.y, 0.5, ['<script>alert("1")</script>', "a&b"], ["<b>y</b>", "'\"z"], name="<i>name</i>"
    )
    source = report.render(optid.fit(hostile, na=1, nb=1, basis="polynomial:2"))
    assert "<script" not in source and "<b>y" not in source and "<i>name" not in source
    text = Page(source).text
    assert '<script>alert("1")</script>' in text and "<i>name</i>" in text and "'\"z" in text


def test_the_test_record_is_validated(pages):
    page = Page(pages["mimo"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optid.errors.DataWarning)
        validation = optid.validate(mimo_fit().model, two_by_two(seed=5))
    assert any("outside" in note for note in validation.notes)
    assert all(note in page.text for note in validation.notes)
    assert "Test record, not seen by the fit" in page.text
    lowest = min(q.fit for q in validation.simulation.values())
    assert f"{lowest:.2f} %" in page.text


def test_figures_follow_the_colours_of_the_page(pages):
    drawings = re.findall(r"<svg .*?</svg>", pages["thruster"], re.DOTALL)
    colours = {colour for drawing in drawings for colour in re.findall(r"#[0-9a-f]{6}\b", drawing)}
    assert colours <= {"#000000", "#ffffff"}  # defaults of glyphs and of what is not drawn
    assert "--blue: light-dark(" in pages["thruster"]


@pytest.mark.slow
def test_write_returns_the_path(tmp_path):
    path = report.write(linear_fit(), tmp_path / "page.html", command="optid fit 'my data.csv'")
    assert "optid fit &#39;my data.csv&#39;" in path.read_text(encoding="utf-8")


def test_a_fit_without_a_model_is_refused():
    fit = optid.fit(
        example_fit("dead_zone").data,
        na=2,
        nb=2,
        basis="triangular:8",
        raises=False,
        constraints=[lambda v: {"low": v["a"][0] <= -1, "high": v["a"][0] >= 1}],
    )
    with pytest.raises(optid.errors.DataError, match="infeasible"):
        report.render(fit)


@pytest.mark.sampled(1)
@pytest.mark.skipif(CHROMIUM is None, reason=NO_BROWSER)
@pytest.mark.parametrize("name", ["thruster", "mimo"])
def test_a_browser_renders_the_page_without_a_complaint(pages, name, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(pages[name], encoding="utf-8")
    result = look(path, tmp_path / "profile", "--dump-dom", "--host-resolver-rules=MAP * ~NOTFOUND")
    assert "CONSOLE" not in result.stderr and "ERR_" not in result.stderr
    rendered, written = Page(result.stdout), Page(pages[name])
    assert " ".join(rendered.text.split()) == " ".join(written.text.split())
    assert result.stdout.count("<path") == pages[name].count("<path")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=NO_BROWSER)
def test_light_and_dark_differ_and_a_phone_needs_no_sideways_scrolling(pages, tmp_path):
    import matplotlib.image

    path = tmp_path / "page.html"
    path.write_text(pages["mimo"], encoding="utf-8")
    brightness = {}
    for scheme, value in (("light", 1), ("dark", 0)):
        shot = tmp_path / f"{scheme}.png"
        look(
            path,
            tmp_path / scheme,
            f"--screenshot={shot}",
            "--window-size=900,1600",
            "--hide-scrollbars",
            f"--blink-settings=preferredColorScheme={value}",
        )
        brightness[scheme] = float(np.median(matplotlib.image.imread(shot)[..., :3]))
    assert brightness["light"] > 0.9 and brightness["dark"] < 0.25
    probe = tmp_path / "probe.html"  # a frame as wide as a phone, because a window cannot be made that narrow
    probe.write_text(
        '<iframe id="f" src="page.html" style="width:360px;height:800px" onload="setTimeout(() => {'
        "const d = document.getElementById('f').contentDocument.documentElement;"
        "document.title = d.scrollWidth + ' of ' + d.clientWidth}, 50)\"></iframe>",
        encoding="utf-8",
    )
    result = look(
        probe, tmp_path / "phone", "--dump-dom", "--virtual-time-budget=3000", "--allow-file-access-from-files"
    )
    width, room = map(int, re.search(r"<title>(\d+) of (\d+)</title>", result.stdout).groups())
    assert 300 < width <= room <= 360


def test_a_state_space_model_shows_singular_values_noise_and_feedback(pages):
    text = Page(pages["feedback"]).text
    for words in ("Singular values from which the order is read", "Spectral density of the noise", "measured feedback",
                  "Feedback nonlinearity g", "On the way to it"):  # fmt: skip
        assert words in text
    assert pages["feedback"].count("<svg ") == 7
