"""Files that mean harm: pages that unfold to gigabytes, cells that steer the terminal."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from refusals import refused

ESC = "\x1b"
EVIL = f"{ESC}[2J{ESC}[31mVerdict: good{ESC}[0m\x9b2J\u202e"


def bomb(levels: int) -> str:
    """A page whose last key stands for nine to the power of its levels."""
    lines = ["a0: &b0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &b{k} [{', '.join([f'*b{k - 1}'] * 9)}]" for k in range(1, levels)]
    return "\n".join([*lines, f"g: *b{levels - 1}", ""])


@pytest.mark.parametrize(
    "arguments", [("calibrate", "{good}", "--config", "bomb.yaml"), ("report", "bomb.yaml", "-o", "a.html")]
)
def test_a_bomb_of_aliases_is_refused_at_once(run, good, arguments, tmp_path):
    Path("bomb.yaml").write_text(bomb(9))
    began = time.perf_counter()
    refused(
        run(*(word.format(good=good) for word in arguments)),
        ["bomb.yaml, line ", "aliases stand for more than"],
    )
    assert time.perf_counter() - began < 10


def test_a_deep_page_is_refused(run, good):
    Path("deep.yaml").write_text("g: " + "[" * 400 + "]" * 400)
    refused(run("calibrate", good, "--config", "deep.yaml"), ["deep.yaml", "deep"])


@pytest.mark.parametrize(
    "text",
    [
        f"ax,ay,az\n1,2,3\n4,{EVIL},6\n",
        f"{EVIL},b,c,d\n1,2,3,4\n4,5,6,7\n",
        f"pose,ax,ay,az\n{EVIL},1,2,3\nb,x,5,6\n",
    ],
)
def test_cells_and_names_in_messages_do_not_steer_the_terminal(run, text):
    Path("evil.csv").write_text(text)
    outcome = run("calibrate", "evil.csv")
    assert outcome.code == 2
    assert ESC not in outcome.err + outcome.out
    assert "\x9b" not in outcome.err


def test_labels_do_not_steer_the_terminal(run, good):
    lines = Path(good).read_text().splitlines()
    rows = [line for line in lines if line and not line.startswith("#")]
    named = [f"pose,{rows[0]}", *(f"p{k}{EVIL},{row}" for k, row in enumerate(rows[1:]))]
    Path("evil.csv").write_text("\n".join(named) + "\n")
    for form in ("table", "json"):
        outcome = run("calibrate", "evil.csv", "--format", form)
        assert "Verdict" in outcome.out or form == "json"
        assert ESC not in outcome.out + outcome.err
        assert "\x9b" not in outcome.out
    Path("key.yaml").write_text(f'"{EVIL.encode("unicode_escape").decode()}": 3\n')
    assert ESC not in run("calibrate", good, "--config", "key.yaml").err
