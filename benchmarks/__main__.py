"""Run the benchmarks, each in a process of its own: `python -m benchmarks [name ...]`, all without a name."""

from __future__ import annotations

import argparse
import subprocess
import sys

BENCHMARKS = (
    "startup",
    "compression",
    "optimizers",
    "csv_speed",
    "detect_speed",
    "apply_speed",
    "fleet_speed",
    "live_view",
)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="name", help=", ".join(BENCHMARKS))
    names = parser.parse_args().names
    if unknown := [name for name in names if name not in BENCHMARKS]:
        parser.error(f"unknown {', '.join(unknown)}; known: {', '.join(BENCHMARKS)}")
    failed = 0
    for name in names or BENCHMARKS:
        print(f"== {name}", flush=True)
        failed += subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=False).returncode != 0
    return failed


if __name__ == "__main__":
    sys.exit(main())
