"""Completion, through the protocol that the scripts of the shells speak."""

import pytest


@pytest.fixture
def complete(shell):
    """Return what bash is offered for the last word of a line."""

    def call(line: str) -> list[str]:
        words = line.split(" ")
        outcome = shell(
            "accelcal", _ACCELCAL_COMPLETE="complete_bash", COMP_WORDS=line, COMP_CWORD=str(len(words) - 1)
        )
        assert (outcome.code, outcome.err) == (0, "")
        return outcome.out.split()

    return call


@pytest.mark.parametrize(
    ("line", "offers"),
    [
        ("accelcal opt", ["optimizers"]),
        ("accelcal calibrate data.csv --optimizer ps", ["pso"]),
        ("accelcal calibrate data.csv --gauge ", ["lower", "upper", "symmetric", "full"]),
        ("accelcal calibrate data.csv --robust ", ["none", "huber", "soft-l1"]),
        ("accelcal calibrate data.csv --format ", ["table", "json", "csv"]),
        ("accelcal calibrate data.csv --min-p", ["--min-poses"]),
        ("accelcal fleet data.csv --weights ", ["none", "n", "sd", "auto"]),
        ("accelcal export result.yaml --to k", ["kalibr"]),
        ("accelcal export result.yaml --dri", ["--driver-scale"]),
        ("accelcal benchmark --func sph", ["sphere"]),
        ("accelcal benchmark --optimizer de-pso,sh", ["de-pso,shade-cma"]),
        ("accelcal compare --gauge ", ["lower", "full"]),
        ("accelcal reproduce dpso-figure", ["dpso-figure2"]),
        (
            "accelcal navigate --filter ",
            ["apo-pf", "de-pf", "mpf", "pf", "point-mass", "pso-pf", "reference", "sitan", "all"],
        ),
        ("accelcal navigate --map ", ["rough", "moderate", "constant"]),
        ("accelcal simulate --sensor ", ["dpso", "mems", "navigation"]),
        ("accelcal plan --fixture ", ["faces", "edges", "corners", "any"]),
        ("accelcal optimizers lev", ["levenberg-marquardt"]),
    ],
)
def test_values_are_offered(complete, line, offers):
    assert complete(line) == offers
