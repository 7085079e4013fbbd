"""Pipes, terminals, interrupts and closed streams: the real program in a real shell."""

import errno
import json
import os
import pty
import re
import signal
import subprocess
import sys

import pytest

from accelcal_cli.cli.main import NAMES

COLOUR = re.compile(r"\x1b\[[0-9;]*3[0-7]m")


def one_line(outcome, *parts):
    assert outcome.err.startswith("accelcal: ")
    assert outcome.err.count("\n") == 1, outcome.err
    for part in parts:
        assert part in outcome.err


def test_simulate_into_calibrate(shell):
    outcome = shell("accelcal simulate --positions 24 | accelcal calibrate - --format json | cat")
    assert json.loads(outcome.out)["verdict"] == "good"
    assert outcome.code == 0


def test_the_same_seed_gives_the_same_bytes_in_another_process(shell):
    line = "accelcal simulate --sensor mems | accelcal calibrate - --seed 5 --format json --quiet"
    assert shell(line, PYTHONHASHSEED="1").out == shell(line, PYTHONHASHSEED="2").out != ""


@pytest.mark.parametrize(
    "line",
    [
        "accelcal simulate --positions 200000",
        "accelcal simulate | accelcal calibrate - -q",
        "accelcal --help",
    ],
)
def test_a_reader_that_leaves_is_no_error(shell, line):
    outcome = shell(f"{line} | head -1; exit ${{PIPESTATUS[-2]}}")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("accelcal calibrate six.csv", 1),
        ("accelcal calibrate six.csv -q -o -", 1),
        ("accelcal calibrate good.csv --tolerance 1e-9 --format json", 1),
        ("accelcal verify good.yaml moved.csv", 1),
        ("accelcal verify good.yaml good.csv", 0),
        ("accelcal fleet six.csv good.csv", 1),
        ("accelcal fleet good.csv moved.csv --format csv --tolerance 1e-9", 1),
        ("accelcal plan six.csv --add 1", 1),
        ("accelcal report six.yaml -o -", 1),
    ],
)
@pytest.mark.parametrize("gone", ["| true", "2>&1 | true", ">&- 2>&-", "> /dev/null"])
def test_a_verdict_is_the_same_whoever_reads_it(shell, line, code, gone):
    """A pipe whose reader has gone before anything is printed, for standard error too; closed streams; all is read."""
    if "report" in line:
        pytest.importorskip("jinja2")
    shell(
        "accelcal simulate --sensor mems --positions 6 > six.csv; accelcal calibrate six.csv -q -o six.yaml; "
        "accelcal simulate --sensor mems --positions 24 > good.csv; accelcal calibrate good.csv -q -o good.yaml; "
        "awk -F, -v OFS=, 'NR > 1 {$3 += 90} 1' good.csv > moved.csv"
    )
    outcome = shell(f"{line} {gone}; exit ${{PIPESTATUS[0]}}")
    assert outcome.code == code
    assert "Traceback" not in outcome.err
    assert "Broken" not in outcome.err


@pytest.mark.parametrize(
    ("stream", "parts"),
    [
        ("head -c 2G /dev/zero", ["<stdin>, line 1", "NUL"]),
        ("yes 0,0,0", ["<stdin>", "readings are all equal"]),
        ("tr '\\0' 1 </dev/zero", ["<stdin>, line 1", "longer than 1 MB"]),
        ("head -c 3M /dev/urandom", ["<stdin>, line "]),
    ],
)
def test_a_stream_of_nonsense_is_cut_off(shell, stream, parts):
    outcome = shell(f"{stream} | accelcal calibrate - -o result.yaml")
    assert outcome.code == 2
    one_line(outcome, *parts)


@pytest.mark.parametrize(
    "line",
    [
        "accelcal simulate",
        "accelcal simulate | accelcal calibrate - -q",
        "accelcal --help",
        "accelcal --version",
    ],
)
def test_a_full_device_is_one_message(shell, line):
    outcome = shell(f"{line} > /dev/full")
    assert outcome.code == 2
    one_line(outcome, "cannot write", os.strerror(errno.ENOSPC).lower())


def test_closed_streams(shell, tmp_path):
    outcome = shell("accelcal calibrate - <&-")
    assert outcome.code == 2
    one_line(outcome, "<stdin>", "empty")
    assert shell("accelcal simulate -o a.csv >&- 2>&- <&-").code == 0
    assert shell("accelcal calibrate a.csv -o b.json >&- 2>&-").code == 0
    assert json.loads((tmp_path / "b.json").read_text())["verdict"] == "good"


def in_terminal(environment, folder, *arguments, **variables):
    """Return what accelcal prints to a terminal, its exit code, and what it says on standard error."""
    ours, theirs = pty.openpty()
    program = subprocess.Popen(
        [sys.executable, "-m", "accelcal_cli", *arguments],
        stdin=theirs,
        stdout=theirs,
        stderr=subprocess.PIPE,
        cwd=folder,
        env={**environment, "TERM": "xterm-256color", **variables},
    )
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # Linux reports the end of a terminal so
            break
        if not part:
            break
        shown += part
    _, error = program.communicate()
    os.close(ours)
    return shown.decode(), program.returncode, error.decode()


def test_colour_on_a_terminal_unless_refused(environment, good, tmp_path):
    shown, code, _ = in_terminal(environment, tmp_path, "calibrate", good)
    assert code == 0
    assert COLOUR.search(shown)
    assert not COLOUR.search(in_terminal(environment, tmp_path, "calibrate", good, NO_COLOR="1")[0])


def test_no_colour_in_a_pipe(shell):
    assert "\x1b" not in shell("accelcal simulate | accelcal calibrate -").out


def test_readings_are_not_awaited_from_a_terminal(environment, tmp_path):
    shown, code, error = in_terminal(environment, tmp_path, "calibrate", "-")
    assert (shown, code) == ("", 2)
    assert error.startswith("accelcal: -: standard input is a terminal; expected")


def numbers(result):
    """Return the numbers of a result as its tables show them."""
    yield from (f"{dop:.3f}" for dop in result["geometry"]["parameters"].values())
    yield from (f"{result[name]:.6g}" for name in ("rms", "rms_before", "s"))
    yield f"{result['cost']:.9g}"
    yield f"{result['evaluations']:,}"


@pytest.mark.parametrize("columns", ["40", "60", "80", "200"])
def test_no_terminal_is_too_narrow_for_a_digit(shell, columns):
    shell("accelcal simulate --sensor mems --positions 24 > data.csv")
    result = json.loads(shell("accelcal calibrate data.csv --format json").out)
    outcome = shell("accelcal calibrate data.csv --verbose", COLUMNS=columns)
    assert outcome.code == 0
    assert "\N{HORIZONTAL ELLIPSIS}" not in outcome.out
    assert max(map(len, outcome.out.splitlines())) <= int(columns)
    words = set(outcome.out.split())
    assert [number for number in numbers(result) if number not in words] == []
    wide = set(shell("accelcal calibrate data.csv --verbose", COLUMNS="300").out.split())
    digits = {word for word in wide if re.fullmatch(r"-?[\d,.]+(e[+-]\d+)?", word)}
    assert {f"{result['K_a'][0][0]:.1f}", f"{result['D_a'][0]:.0f}"} <= digits
    assert digits - {"24.", "60,000", "60,100", "50,100"} <= words


def test_an_ascii_terminal_gets_ascii(shell):
    outcome = shell("accelcal simulate | accelcal calibrate -", PYTHONIOENCODING="ascii")
    assert outcome.code == 0
    assert outcome.out.isascii()


def test_zero_columns_are_no_width(shell):
    shell("accelcal simulate > data.csv")
    known = shell("accelcal calibrate data.csv -q").out
    assert known
    assert shell("accelcal calibrate data.csv -q", COLUMNS="0").out == known


def test_what_the_encoding_of_the_terminal_lacks_is_no_failure(shell):
    shell("accelcal simulate | sed '1s/^/pose,/; 1!s/^[^.]*\\./\u00e4&,&/' > data.csv")
    for form in ("table", "json", "csv"):
        outcome = shell(f"accelcal calibrate data.csv -q --format {form}", PYTHONIOENCODING="ascii")
        assert (outcome.code, outcome.err) == (0, "")
        assert outcome.out.isascii()
    page = "accelcal calibrate data.csv -q -o - | accelcal report - -o -"
    assert "\u00e4" in shell(page, PYTHONIOENCODING="latin-1").out


def test_a_result_comes_from_standard_input(shell):
    shell("accelcal simulate > data.csv; accelcal calibrate data.csv -q -o result.yaml")
    assert shell("accelcal export - --to c-header < result.yaml").out.startswith("#ifndef")
    assert shell("accelcal verify - data.csv < result.yaml").out.startswith("Verdict: unchanged")
    outcome = shell("accelcal apply - - < result.yaml")
    assert outcome.code == 2
    one_line(outcome, "- -", "standard input", "name of the result file")
    outcome = shell("accelcal export - --to c-header < data.csv")
    assert outcome.code == 2
    one_line(outcome, "<stdin>", "result file of a calibration")


@pytest.mark.parametrize("busy", ["reading", "searching"])
def test_an_interrupt_is_one_line_and_leaves_no_file(environment, tmp_path, busy):
    program = subprocess.Popen(
        [sys.executable, "-m", "accelcal_cli", "calibrate", "-", "--runs", "100000", "-o", "result.yaml"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=tmp_path,
        env=environment,
    )
    rows = b"".join(b"%d,%d,%d\n" % (i % 7, i % 11, i % 13) for i in range(100_000))
    program.stdin.write(rows)  # more than a pipe holds: when it is written the program is at work
    if busy == "searching":
        program.stdin.close()
        program.stdin = None
        with pytest.raises(subprocess.TimeoutExpired):
            program.communicate(timeout=1)  # a hundred thousand searches take longer
    program.send_signal(signal.SIGINT)
    out, error = program.communicate()
    assert (program.returncode, out, error) == (130, b"", b"accelcal: interrupted\n")
    assert os.listdir(tmp_path) == []


def test_the_help_says_what_each_command_does_in_a_whole_sentence(run):
    listed = run("--help").out.partition("Commands:\n")[2].splitlines()
    assert len(listed) == len(NAMES)
    assert all(line.endswith(".") and not line.endswith("...") for line in listed)


@pytest.mark.parametrize("name", NAMES)
def test_every_command_can_be_quiet(run, name):
    assert "-q, --quiet" in run(name, "--help").out


def test_standard_output_by_its_name_is_what_the_shell_opened(shell, tmp_path):
    outcome = shell("echo first > out.yaml; accelcal simulate --sensor mems -q -o /dev/stdout >> out.yaml")
    assert (outcome.code, outcome.err) == (0, "")
    assert (tmp_path / "out.yaml").read_text().splitlines()[:2] == ["first", "Nx,Ny,Nz"]
