"""Run accelcal as `python -m accelcal_cli`."""

import gc
import os
import sys

COLLECT_AFTER = 100_000
"""Objects more than are freed that start a collection of garbage. Imports make tens of thousands and free none: with
Python's 700 they cost a tenth of a start."""


THREADS = "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"
"""What numpy's linear algebra reads its number of threads from, whichever it was built with. Our matrices are small:
threads would wait for each other, and work is shared among processes (--jobs)."""


def main() -> None:
    """Run the command line; an interrupt while it is still being imported is one line, too."""
    gc.set_threshold(COLLECT_AFTER)
    for name in THREADS:
        os.environ.setdefault(name, "1")
    try:
        from accelcal_cli.cli.main import main as run
    except KeyboardInterrupt:
        sys.stderr.write("accelcal: interrupted\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
