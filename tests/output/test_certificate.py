"""The certificate: the numbers of the record, nothing that is not true, and two whole sides on either paper."""

from __future__ import annotations

import functools
import html
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from simulated import MEMS, noise, readings

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.provenance import LONGEST, MOST, settings_sha256
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.cli.report import PAPERS
from accelcal_cli.errors import UsageError
from accelcal_cli.io.readings import Readings
from accelcal_cli.notices import Notice
from accelcal_cli.output import certificate
from accelcal_cli.output.certificate import page
from accelcal_cli.sensor import poses
from accelcal_cli.views import certificate as views
from accelcal_cli.views import quoted

G = 9.8
META = {"serial": "A-17", "model": "ADXL355", "operator": "Jo Smith", "temperature": "21.5 degrees C"}


def _warm():
    warm = np.tile([10.0, 40.0, 25.0], 16)
    output = MEMS.output(G * poses.fibonacci(48)) + 0.01 * (warm[:, None] - 25.0) + noise(48, 1e-3, 4)
    return calibrate(Readings.from_array(output, temperature=warm), Settings(g=G, optimizer="ellipsoid"))


def _suspect():
    output = MEMS.output(G * poses.fibonacci(24) + noise(24, 1e-3, 2))
    output[[5, 7]] *= 1.05
    return calibrate(Readings.from_array(output), Settings(g=G, optimizer="ellipsoid"))


def _known():
    force = G * poses.fibonacci(24)
    data = Readings.from_array(MEMS.output(force + noise(24, 1e-3, 2)), reference=force)
    return calibrate(data, Settings(g=G, attitudes="known", gauge="full"))


def _worst():
    """More notices, longer ones and more entries than anything should have, in wide letters."""
    long = "The readings of position %d are outside of what the others say, and the reason is not known. " * 4
    severities = ("warning", "note")
    notices = tuple(
        Notice(
            f"a-long-key-{k}",
            severities[k % 2],
            long.replace("%d", str(k)),
            "Measure again, or add --robust huber.",
        )
        for k in range(30)
    )
    meta = {f"{'key' * 12}-{k}": ("北京市海淀区" * 40)[:LONGEST] for k in range(MOST)}
    reasons = tuple(f"Weakly determined: {'scale factor x, ' * 12}and so on." for _ in range(4))
    source = {**_warm().data, "source": "folder/" * 40 + "readings.csv"}
    return replace(_warm(), warnings=notices, reasons=reasons, meta=meta, verdict="suspect", data=source)


MAKERS = {
    "good": lambda: calibrate(
        readings(poses.turns(), sigma=1e-3), Settings(g=G, optimizer="ellipsoid"), meta=META
    ),
    "suspect": _suspect,
    "warnings": lambda: replace(_worst(), warnings=_worst().warnings[:4], reasons=(), meta=META),
    "worst": _worst,
    "meta": lambda: replace(_known(), meta={f"k{k}": "W" * LONGEST for k in range(MOST)}),
    "table": lambda: replace(_warm(), meta={f"{'k' * 25}{k:02}": "W" * 40 for k in range(12)}),
    "known": _known,
    "warm": _warm,
    "perpendicular": lambda: calibrate(
        readings(poses.turns(), sigma=0.1), Settings(g=G, optimizer="ellipsoid", misalignment=False)
    ),
    "six": lambda: calibrate(
        readings(poses.faces(), sigma=1e-3), Settings(g=G, optimizer="ellipsoid", misalignment=False)
    ),
    "many": lambda: calibrate(
        readings(poses.fibonacci(1200), sigma=1e-3), Settings(g=G, optimizer="ellipsoid")
    ),
}


@functools.cache
def _result(kind):
    return MAKERS[kind]()


def _text(kind, paper="a4", title=None):
    """The words of a certificate without its pictures."""
    text = re.sub(r"<(style|svg)\b.*?</\1>", " ", page(_result(kind), "r", title, paper), flags=re.DOTALL)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", text)))


@pytest.mark.parametrize("kind", ["good", "suspect", "known", "warm", "perpendicular"])
def test_numbers_are_those_of_the_record(kind):
    result, text = _result(kind), _text(kind)
    record = result.record()
    factor = record["coverage_factor"]
    assert f"k = {factor:.3g} times sigma" in text
    for i in range(3):
        for values, halves in (
            (record["K_a"][i], record["interval"]["K_a"][i]),
            ([record["D_a"][i]], [record["interval"]["D_a"][i]]),
        ):
            for value, half in zip(values, halves, strict=True):
                if half:
                    shown, spread = quoted.quote(value, half)
                    assert f"{shown} ± {spread} sigma {quoted.quote(0.0, half / factor)[1]}" in text
    for key, size in (("scale_error", 1e6), ("misalignment", 1e3)):
        own = record["engineering"][key]
        for value, half in zip(own["value"], own["interval"], strict=True):
            if key == "scale_error" or not result.held[3]:
                assert " ± ".join(quoted.quote(value * size, half * size)) in text
    for part in (
        record["data"]["sha256"],
        settings_sha256(record["settings"]),
        f"accelcal {record['version']}",
        "2025-12-01 00:00:00 UTC",
        f"{record['g']:.7g} m/s²",
        record["g_source"],
        f"degrees of freedom {record['freedom']}",
        f"rms of |f| - g after {record['rms']:.3g} m/s²",
        f"Verdict: {record['verdict']}",
        *record["reasons"],
        *(notice["text"] for notice in record["warnings"]),
    ):
        assert part in text, part


def test_what_was_stated_is_on_the_first_side():
    first = _text("good").partition("side 2 of 2")[0]
    for key, value in META.items():
        assert f"{key} {value}" in first


def test_what_was_not_estimated_is_not_there():
    text = _text("perpendicular")
    assert not re.search(r"misalignment (xy|xz|yz)", text)
    assert "Misalignments were not estimated" in text
    assert "scale factors and bias (axes taken as perpendicular)" in text
    assert "coverage factor" not in _text("six")
    assert "no uncertainty can be stated" in _text("six")


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("good", ("unknown attitude", "searched by ellipsoid", "Levenberg-Marquardt")),
        ("known", ("linear least squares", "specific force f of each of 24 poses")),
        ("warm", ("slopes of scale factors and bias against temperature", "poses at 10 to 40 degrees")),
    ],
)
def test_the_method_is_the_one_that_was_used(kind, words):
    for part in words:
        assert part in _text(kind)
    assert ("unknown attitude" in _text(kind)) == (kind != "known")


@pytest.mark.parametrize("kind", ["good", "suspect", "six"])
def test_it_claims_neither_accreditation_nor_traceability(kind):
    text = _text(kind)
    assert "no accreditation and no metrological traceability are stated or implied" in text
    for word in ("accredit", "traceab", "ISO", "17025", "laboratory"):
        assert text.lower().count(word.lower()) == (word in ("accredit", "traceab", "laboratory"))


def test_an_undetermined_result_has_none():
    result = calibrate(
        readings(np.tile(poses.faces(), (2, 1)), sigma=1e-3), Settings(g=G, optimizer="ellipsoid")
    )
    with pytest.raises(
        UsageError, match=r"^r\.yaml: its verdict is undetermined \(.+\), so there is nothing to certify"
    ):
        page(result, "r.yaml")


def test_what_has_no_room_is_named():
    identification = views.stated(_result("worst").meta)
    assert identification.dense
    assert len(identification.entries) + 6 < MOST
    assert re.fullmatch(r"(\S+, ){5}\S+ and \d+ more", identification.left_out)
    said = views.said(_result("worst"))
    assert said.shortened
    assert said.sentences[4].startswith("Warning: The readings of position 0")
    assert "more" in said.left_out
    assert "the result file has the full sentences" in _text("worst")


def test_the_papers_of_the_command_are_those_of_the_page():
    assert tuple(certificate.PAPERS) == PAPERS
    with pytest.raises(UsageError, match=r'^--paper "a3": unknown'):
        page(_result("good"), "r", paper="a3")


def test_the_same_result_gives_the_same_page():
    assert page(_result("good"), "r") == page(_result("good"), "r")
    assert "<script" not in page(_result("good"), "r")


# Printed by a browser


CUT = """
return [...document.querySelectorAll(".sheet")].flatMap(sheet => {
  const box = sheet.getBoundingClientRect();
  return [...sheet.querySelectorAll("*:not(title)")].filter(e => {
    const own = e.getBoundingClientRect();
    return own.right > box.right + 0.5 || own.bottom > box.bottom + 0.5 || own.left < box.left - 0.5;
  }).map(e => e.outerHTML.slice(0, 100));
})
"""
SIZES = {"a4": (594.96, 841.92), "letter": (612.0, 792.0)}


@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize("kind", MAKERS)
def test_it_prints_on_two_sides_and_nothing_is_cut(browser, tmp_path, kind, paper):
    file = tmp_path / "certificate.html"
    file.write_text(
        page(_result(kind), "r", "A heading that is long " * 8 if kind == "worst" else None, paper), "utf-8"
    )
    browser.requests()
    browser.open(file)
    assert browser.requests() == [file.as_uri()]
    assert browser.run(CUT) == []
    browser.pdf(tmp_path / "certificate.pdf")
    content = (tmp_path / "certificate.pdf").read_bytes()
    assert re.search(rb"/Type /Pages\s+/Count 2\b", content)
    boxes = {tuple(map(float, box.split())) for box in re.findall(rb"/MediaBox \[([^\]]*)\]", content)}
    (box,) = boxes
    assert box[2:] == pytest.approx(SIZES[paper], abs=1.0)


@pytest.mark.skipif(
    shutil.which("pdftotext") is None, reason="needs pdftotext: apt-get install poppler-utils"
)
@pytest.mark.parametrize("kind", ["good", "suspect", "worst"])
def test_every_word_of_the_page_is_in_the_print(browser, tmp_path, kind):
    file = tmp_path / "certificate.html"
    file.write_text(page(_result(kind), "r"), "utf-8")
    browser.open(file)
    browser.pdf(tmp_path / "certificate.pdf")
    printed = subprocess.run(
        ["pdftotext", "-raw", tmp_path / "certificate.pdf", "-"],
        capture_output=True,
        encoding="utf-8",
        check=True,
    ).stdout
    sides = printed.rstrip("\f\n").split("\f")
    assert len(sides) == 2
    assert "side 1 of 2" in sides[0]
    assert sides[1].rstrip().endswith("stated or implied.")
    asked = (
        "const c = document.body.cloneNode(true); c.querySelectorAll('svg title').forEach(t => t.remove());"
        "return c.textContent"
    )
    flat = re.sub(r"\s", "", printed)
    missing = [word for word in browser.run(asked).split() if word.isascii() and word not in flat]
    assert missing == []
