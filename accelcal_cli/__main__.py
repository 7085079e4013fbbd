"""Run accelcal as `python -m accelcal_cli`."""

import sys


def main() -> None:
    """Run the command line; an interrupt while it is still being imported is one line, too."""
    try:
        from accelcal_cli.cli.main import main as run
    except KeyboardInterrupt:
        sys.stderr.write("accelcal: interrupted\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
