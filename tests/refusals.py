"""What every refused command owes its user."""


def refused(outcome, parts):
    """Check the exit code, the silence of standard output and the one line of the message."""
    assert outcome.code == 2
    assert outcome.out == ""
    assert outcome.err.startswith("accelcal: ")
    assert outcome.err.count("\n") == 1, outcome.err
    assert len(outcome.err) < 500
    for part in parts:
        assert part in outcome.err, outcome.err
