"""Run accelcal as `python -m accelcal_cli`."""

from accelcal_cli.cli.main import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
