"""Run accelcal as `python -m accelcal_cli`."""

import gc
import sys

COLLECT_AFTER = 100_000
"""Objects more than are freed that start a collection of garbage. Imports make tens of thousands and free none: with
Python's 700 they cost a tenth of a start."""


def main() -> None:
    """Run the command line; an interrupt while it is still being imported is one line, too."""
    gc.set_threshold(COLLECT_AFTER)
    try:
        from accelcal_cli.cli.main import main as run
    except KeyboardInterrupt:
        sys.stderr.write("accelcal: interrupted\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
