"""The report: whole, self-contained, the same twice; and what a browser makes of it."""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from simulated import MEMS, noise, readings

import accelcal_cli
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import UsageError
from accelcal_cli.io.readings import Readings
from accelcal_cli.output import certificate, figures
from accelcal_cli.output.document import prose, typeset
from accelcal_cli.output.report import fleet_page, page, side_by_side
from accelcal_cli.sensor import poses
from accelcal_cli.views.quoted import quote

G = 9.8
VOID = ("meta", "link", "br")


@functools.cache
def _result(kind):
    search = {"optimizer": "pso", "parameters": {"population": 20, "iterations": 40}, "g": G}
    if kind == "good":
        return calibrate(readings(poses.turns(), sigma=1e-3), Settings(**search))
    if kind == "outlier":
        output = MEMS.output(G * poses.fibonacci(40) + noise(40, 1e-3, 2))
        output[7] += 0.3
        return calibrate(Readings.from_array(output), Settings(**search, robust="huber"))
    if kind == "undetermined":
        return calibrate(readings(np.tile(poses.faces(), (2, 1)), sigma=1e-3), Settings(**search))
    if kind == "perpendicular":
        return calibrate(readings(poses.turns(), sigma=0.1), Settings(**search, misalignment=False))
    return calibrate(readings(poses.fibonacci(1200), sigma=1e-3), Settings(**search))


KINDS = ("good", "outlier", "undetermined", "perpendicular", "many")


@functools.cache
def _page(kind):
    return page(_result(kind), "Sensor 7")


def _drawings(kind):
    """The pictures of a page by their names."""
    found = re.findall(r'<svg [^>]*aria-labelledby="(\w+)-alt"[^>]*>.*?</svg>', _page(kind), re.DOTALL)
    whole = re.findall(r"<svg .*?</svg>", _page(kind), re.DOTALL)
    return dict(zip(found, whole, strict=True))


@pytest.fixture(scope="module")
def good():
    return _result("good")


class Reader(HTMLParser):
    """Checks that tags close in order; keeps the tags, the ids and the text of a page."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.ids, self.text = [], [], [], ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.tags.append((tag, found))
        self.ids += [found["id"]] if "id" in found else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self.ids += [dict(attributes)["id"]] if "id" in dict(attributes) else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data if self.open and self.open[-1] not in ("style", "script") else ""


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_is_whole_and_needs_nothing_else(kind):
    text = _page(kind)
    seen = Reader(text)
    assert len(seen.ids) == len(set(seen.ids))
    tags = [tag for tag, _ in seen.tags]
    assert not {"img", "iframe", "object", "image"} & set(tags)
    links = [a.get(key, "") for _, a in seen.tags for key in ("href", "src", "xlink:href")]
    assert all(link == "" or link.startswith(("#", "data:")) for link in links)
    assert not re.search(r"url\((?!#)|@import", text)
    used = re.findall(r"(?:url\(|href=\")#([^\")]+)", text)
    assert set(used) <= set(seen.ids)
    assert not re.search(r"\bnan\b", seen.text)


@pytest.mark.parametrize("kind", KINDS)
def test_the_policy_allows_its_own_style_and_script_alone(kind):
    text = _page(kind)
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    policy = policy.replace("&#39;", "'")
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy
    for tag in ("style", "script"):
        (own,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        assert f"'sha256-{base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()}'" in policy
    assert not re.search(r"<[^>]* (style|on\w+)=", text)


@pytest.mark.parametrize("kind", KINDS)
def test_the_verdict_comes_first(kind):
    result = _result(kind)
    text = re.sub(r"\s+", " ", Reader(_page(kind)).text)
    assert text.index(f"Verdict: {result.verdict}") < text.index("Parameters")
    for sentence in (*result.reasons, *map(str, result.warnings), *result.notes, result.before):
        assert typeset(sentence) in text


def test_what_was_not_estimated_is_not_shown_as_if_it_were():
    text = Reader(_page("perpendicular")).text
    assert "The poses determine all six parameters that were estimated." in text
    assert "Misalignments were not estimated" in text
    assert not re.search(r"misalignment (xy|xz|yz)", text)
    assert "taken as 0" not in text
    assert "misalignment" not in _drawings("perpendicular")["dilution"]


def test_a_page_holds_every_part(good):
    text = Reader(_page("good")).text
    for part in (
        "Sensor 7",
        good.data["sha256"],
        f"accelcal {accelcal_cli.__version__}",
        "accelcal/calibration/3",
        *quote(good.K_a[0, 0], good.interval.K_a[0, 0]),
        *quote(good.D_a[2], good.interval.D_a[2]),
        "scale factor error x",
        "misalignment yz",
        "population: 20",
        good.poses_fit[23].where,
        f"{good.poses_fit[23].residual_before:.3e}",
        f"{good.dop.worst:.3g}",
    ):
        assert part in text, part


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_there_with_a_text_and_take_the_colours_of_the_page(kind):
    drawings = _drawings(kind)
    assert list(drawings) == ["residuals", "sphere", "dilution", "convergence"]
    for svg in drawings.values():
        assert 'role="img"' in svg
        assert "viewBox" in svg
        assert len(re.findall(r"<title [^>]*>[^<]{40,}</title>", svg)) == 1
        assert not re.search(r"#[0-9a-fA-F]{3,6}\b|font-family|(fill|stroke|style)=", svg)
        assert 'class="' in svg


def test_an_outlier_is_marked_in_both_pictures_of_poses():
    assert _result("outlier").outliers == (7,)
    assert "outliers (with a cross): 1" in _drawings("outlier")["residuals"]
    for name in ("residuals", "sphere"):
        assert _drawings("outlier")[name].count('class="cross"') == (2 if name == "residuals" else 1)
        assert 'class="cross"' not in _drawings("good")[name]


@pytest.mark.parametrize("name", ["residuals", "sphere"])
def test_every_mark_names_its_pose(good, name):
    marks = re.findall(
        r'<g class="mark" data-key="pose-(\d+)"><title>([^<]*)</title>', _drawings("good")[name]
    )
    assert [int(number) for number, _ in marks] == [fit.pose + 1 for fit in good.poses_fit]
    for (_, title), fit in zip(marks, good.poses_fit, strict=True):
        assert title.startswith(f"Pose {fit.pose + 1}")
        for part in (fit.where, f"{fit.residual:.3e} m/s\u00b2 after", f"leverage {fit.leverage:.2f}"):
            assert part in title.replace("Pose", "pose")
    assert _page("good").count('data-key="pose-1"') >= 3  # and the row of the table


def test_the_verdict_says_how_well_the_parameters_are_known(good):
    interval = (
        good.coverage_factor * np.sqrt(np.diagonal(good.covariance)) / good.g * np.repeat([1e6, 1e3, 1e6], 3)
    )
    said = re.search(
        r"scale ([\d.,]+) ppm, misalignment ([\d.,]+) mrad, bias ([\d.,]+) micro-g", _page("good")
    )
    largest = [float(value.replace(",", "")) for value in said.groups()]
    np.testing.assert_allclose(largest, interval.reshape(3, 3).max(axis=1), rtol=0.05)
    assert "Largest half of a 95 % interval" not in _page("undetermined")


def test_units_have_raised_powers():
    assert (
        typeset("rms [m/s^2], L [(m/s^2)^4], [(g)^4]") == "rms [m/s\u00b2], L [(m/s\u00b2)\u2074], [g\u2074]"
    )
    for kind in KINDS:
        assert "^" not in Reader(_page(kind)).text


def test_every_table_has_a_caption_and_headings():
    text = _page("good")
    tables = re.findall(r"<table>.*?</table>", text, re.DOTALL)
    assert len(tables) == 6
    for table in tables:
        assert table.count("<caption>") == 1
        assert '<th scope="col"' in table
        assert '<th scope="row"' in table
        assert not re.search(r"<th[^>]*></th>", table)


def test_slopes_with_temperature_are_there_when_they_are_known():
    warm = np.tile([10.0, 40.0, 25.0], 16)
    output = MEMS.output(G * poses.fibonacci(48)) + 0.01 * (warm[:, None] - 25.0) + noise(48, 1e-3, 4)
    result = calibrate(Readings.from_array(output, temperature=warm), Settings(g=G, optimizer="ellipsoid"))
    assert result.temperature is not None
    assert "The other parameters hold at" in page(result, "Sensor 7")


def test_without_a_curve_there_is_no_picture_of_it(good):
    record = {**good.record(), "convergence": []}
    text = page(Calibration.from_record(record, "r"), "Sensor 7")
    assert figures.convergence(Calibration.from_record(record, "r")) == ""
    assert "Convergence" not in text
    assert text.count("<svg") == 3


def test_a_record_without_poses_has_a_page(good):
    record = {**good.record(), "poses_fit": [], "outliers": [], "convergence": []}
    text = page(Calibration.from_record(record, "r"), "Sensor 7")
    assert text.count("<svg") == 2


def test_the_same_result_gives_the_same_page(good):
    again = Calibration.from_record(json.loads(json.dumps(good.record())), "r")
    assert _page("good") == page(again, "Sensor 7")


def test_text_of_the_result_is_not_taken_for_html(good):
    evil = "<script>alert(1)</script>"
    record = good.record()
    record |= {"optimizer": evil, "before": evil, "notes": [evil], "reasons": [evil]}
    record["data"] = {"source": evil, "sha256": evil, "columns": [evil]}
    record["poses_fit"][0]["where"] = evil
    text = page(Calibration.from_record(record, "r"), evil)
    assert text.count("<script") == 1
    assert text.count("&lt;script&gt;") >= 8


def test_what_is_not_determined_has_no_number():
    text = Reader(_page("undetermined")).text
    assert "not determined" in text
    assert "noise of one pose, s" in text  # twelve poses of six attitudes have degrees of freedom
    row = re.search(
        r"<tr>\s*<th[^>]*>misalignment xy \[mrad\]</th>(.*?)</tr>", _page("undetermined"), re.DOTALL
    )[1]
    assert re.findall(r">([^<]*)</td>", row) == ["not determined", "", ""]


def test_options_and_short_names_are_not_split():
    assert str(prose("add --no-misalignment, de-pso <x>")) == (
        'add <code>--no-misalignment</code>, <span class="whole">de-pso</span> &lt;x&gt;'
    )


def test_axes_are_not_split_from_their_signs():
    assert str(prose("between +x and -z up")) == 'between +x and <span class="whole">-z</span> up'


def test_results_stand_side_by_side_with_their_differences():
    first, second = _result("good"), _result("outlier")
    text = side_by_side({"before": first, "after": second}, "Desk 1")
    seen = Reader(text)
    assert len(seen.ids) == len(set(seen.ids))
    for part in ("before", "after", "after less before", "SHA-256 of the settings", second.data["sha256"]):
        assert part in seen.text
    for result in (first, second):
        assert typeset(f"{result.rms:.3g}") in seen.text
    assert 'data-key="pose-0-8"' in text
    assert 'data-key="pose-1-8"' in text


def test_results_of_two_units_do_not_stand_side_by_side():
    other = calibrate(readings(poses.turns(), sigma=1e-3), Settings(g=1.0, optimizer="ellipsoid"))
    with pytest.raises(UsageError, match=r"^b: is in g, and a in m/s\^2"):
        side_by_side({"a": _result("good"), "b": other}, "Desk 1")


def test_a_fleet_has_a_row_and_a_mark_for_every_sensor():
    results = {
        f"S{k}": _result(kind) for k, kind in enumerate(("good", "outlier", "undetermined", "good", "many"))
    }
    text = Reader(fleet_page(results, "Fleet")).text
    words = [result.verdict for result in results.values()]
    for word in set(words):
        assert re.search(rf"{words.count(word)}\s*{word}", text)
    for label in results:
        assert label in text
    assert re.search(
        r"of 4 sensors: S", fleet_page(results, "Fleet")
    )  # without the one that is not determined
    assert fleet_page(results, "Fleet") == fleet_page(results, "Fleet")


# In a browser


BOXES = """
return [...document.querySelectorAll("svg")].map(svg => {
  const box = svg.getBoundingClientRect(), style = getComputedStyle(svg);
  return [box.left, box.right, box.height, svg.querySelectorAll("*").length, style.visibility];
})
"""
CONTRAST = """
const luminance = text => {
  const [r, g, b] = text.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255)
    .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const behind = node => {
  for (; node; node = node.parentElement) {
    const colour = getComputedStyle(node).backgroundColor;
    if (!/^rgba\\(.*, 0\\)$/.test(colour)) return colour;
  }
  return "rgb(255, 255, 255)";
};
const all = "h1, h2, p, dt, dd, th, td, caption, figcaption, summary, pre, svg text";
return [...document.querySelectorAll(all)].map(node => {
  const style = getComputedStyle(node);
  const ink = luminance(node.namespaceURI.endsWith("svg") ? style.fill : style.color);
  const page = luminance(behind(node));
  return [(Math.max(ink, page) + 0.05) / (Math.min(ink, page) + 0.05), node.textContent.trim()];
})
"""


@pytest.mark.parametrize("width", [1100, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_browser_shows_it_in_both_schemes_and_on_a_telephone(browser, tmp_path, kind, scheme, width):
    file = tmp_path / "report.html"
    file.write_text(_page(kind), encoding="utf-8")
    browser.requests(), browser.log("browser")
    browser.open(file, width=width, scheme=scheme)
    assert browser.requests() == [file.as_uri()]
    assert browser.log("browser") == []
    shown = browser.run("return document.body.innerText")
    assert f"Verdict: {_result(kind).verdict}" in shown
    assert browser.run("return document.documentElement.scrollWidth") <= width
    drawings = browser.run(BOXES)
    assert len(drawings) == 4
    for left, right, height, marks, visibility in drawings:
        assert 0 <= left < right <= width
        assert height > 150
        assert marks > 15
        assert visibility == "visible"
    background = browser.run("return getComputedStyle(document.body).backgroundColor")
    assert (background == "rgb(255, 255, 255)") == (scheme == "light")
    low = [(ratio, text) for ratio, text in browser.run(CONTRAST) if ratio < 4.5]
    assert low == []


AXE = (
    Path(os.environ.get("ACCELCAL_AXE", Path(__file__).parents[2] / "node_modules" / "axe-core"))
    / "axe.min.js"
)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("kind", ["outlier", "two", "fleet", "certificate"])
def test_axe_has_no_serious_finding(browser, tmp_path, kind, scheme):
    if not AXE.is_file():
        pytest.skip("no axe-core here: npm install axe-core, or ACCELCAL_AXE names its folder")
    file = tmp_path / "report.html"
    file.write_text(_several(kind), encoding="utf-8")
    browser.open(file, scheme=scheme)
    browser.run(f"{AXE.read_text('utf-8')}; window.axe = axe")
    asked = "axe.run().then(r => JSON.stringify([r.passes.length, r.violations.map(v => [v.id, v.impact])]))"
    found = browser.devtools("Runtime.evaluate", expression=asked, awaitPromise=True)["result"]["value"]
    passes, violations = json.loads(found)
    assert passes > 15
    assert [v for v in violations if v[1] in ("serious", "critical")] == []


def _several(kind):
    results = {name: _result(name) for name in ("good", "outlier")}
    return {
        "outlier": lambda: _page("outlier"),
        "certificate": lambda: certificate.page(_result("outlier"), "r"),
        "two": lambda: side_by_side(results, "Two"),
        "fleet": lambda: fleet_page({**results, **{str(k): _result("good") for k in range(4)}}, "Fleet"),
    }[kind]()


def test_pointing_at_a_pose_or_moving_the_slider_names_it_everywhere(browser, tmp_path):
    file = tmp_path / "report.html"
    file.write_text(_page("outlier"), encoding="utf-8")
    browser.open(file)
    lit = "return [...document.querySelectorAll('.on')].map(e => [e.localName, e.dataset.key])"
    assert browser.run(lit) == []
    place = browser.run(
        "const m = document.querySelector('svg [data-key=pose-8] .zone'); m.scrollIntoView({block: 'center'});"
        "const r = m.getBoundingClientRect(); return [r.left + r.width / 2, r.top + r.height / 2]"
    )
    browser.devtools("Input.dispatchMouseEvent", type="mouseMoved", x=place[0], y=place[1])
    said = browser.run("return document.querySelector('.probe output').textContent")
    fit = _result("outlier").poses_fit[7]
    assert said.startswith("Pose 8")
    assert f"leverage {fit.leverage:.2f}" in said
    assert {key for _, key in browser.run(lit)} == {"pose-8"}
    assert [name for name, _ in browser.run(lit)].count("g") == 2
    assert "tr" in [name for name, _ in browser.run(lit)]
    browser.run("const i = document.querySelector('.probe input'); i.focus()")
    for kind in ("rawKeyDown", "keyUp"):
        browser.devtools("Input.dispatchKeyEvent", type=kind, key="ArrowRight", windowsVirtualKeyCode=39)
    assert browser.run("return document.querySelector('.probe output').textContent").startswith("Pose 9")
    read = "return document.querySelector('.probe input').getAttribute('aria-valuetext')"
    assert browser.run(read).startswith("Pose 9")


@pytest.mark.parametrize("kind", ["outlier", "undetermined", "two", "fleet"])
def test_nothing_is_clipped_in_print(browser, tmp_path, kind):
    long = "a_very_long_label_without_a_blank_" * 4
    text = _several(kind) if kind in ("two", "fleet") else _page(kind)
    if kind == "outlier":
        record = _result(kind).record()
        record["poses_fit"][3]["where"] = record["data"]["source"] = long
        text = page(Calibration.from_record(record, "r"), long)
    file = tmp_path / "report.html"
    file.write_text(text, encoding="utf-8")
    browser.open(file, width=688)  # 182 mm: A4 within its margins
    browser.devtools("Emulation.setEmulatedMedia", media="print")
    wide = browser.run(
        "return [...document.querySelectorAll('main *')]"
        ".filter(e => e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 120))"
    )
    browser.devtools("Emulation.setEmulatedMedia", media="")
    assert wide == []


def test_it_prints_dark_on_white_with_everything_unfolded(browser, tmp_path):
    file = tmp_path / "report.html"
    file.write_text(_page("good"), encoding="utf-8")
    browser.open(file, scheme="dark")
    features = [{"name": "prefers-color-scheme", "value": "dark"}]
    browser.devtools("Emulation.setEmulatedMedia", media="print", features=features)
    style = browser.run("const s = getComputedStyle(document.body); return [s.backgroundColor, s.color]")
    assert style == ["rgb(255, 255, 255)", "rgb(0, 0, 0)"]
    assert browser.run("return document.querySelector('details table').getBoundingClientRect().height") > 100
    browser.print(tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    browser.devtools("Emulation.setEmulatedMedia", media="", features=[])
