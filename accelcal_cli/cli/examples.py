"""What help shows beside the options: a guide for those who ask for nothing, and examples of each command."""

from __future__ import annotations

GUIDE = """\
accelcal calibrates three-axis accelerometers without a turntable.

Start here:
  accelcal simulate --sensor mems -o data.csv  readings to try
  accelcal calibrate data.csv                  K matrix, bias, verdict
  accelcal calibrate log.csv --raw             the same, of a log of a sensor
                                               that is turned and held still

Then:
  accelcal calibrate data.csv -o result.yaml   keep the result
  accelcal report result.yaml -o page.html     a page with pictures
  accelcal export result.yaml --to c-header    for a firmware; or px4, ros, ...
  accelcal plan result.yaml                    the poses to take next
  accelcal verify result.yaml new.csv          has the sensor changed?

All commands: accelcal --help. One of them: accelcal help calibrate.
"""

EXAMPLES: dict[str, tuple[str, ...]] = {
    "calibrate": (
        "accelcal calibrate data.csv --g 9.80665",
        "accelcal calibrate data.csv --latitude 48.1 --height 500 -o result.yaml",
        "accelcal calibrate log.csv --raw",
        "accelcal calibrate data.csv --robust huber --verbose",
    ),
    "simulate": (
        "accelcal simulate --sensor mems --positions 24 --samples 10 -o data.csv",
        "accelcal simulate --raw --positions 13 -o log.csv",
        "accelcal simulate --sensor mems --sensors 100 --positions 24 -o fleet.csv",
    ),
    "detect": (
        "accelcal detect log.csv",
        "accelcal detect log.csv -o poses.csv --plot poses.svg",
        "accelcal detect log.csv --window 2 --min-poses 6",
    ),
    "apply": (
        "accelcal apply result.yaml log.csv -o calibrated.csv",
        "accelcal apply result.yaml log.csv --unit g --tilt -o calibrated.csv",
    ),
    "verify": (
        "accelcal verify result.yaml new.csv",
        "accelcal verify result.yaml new.csv --level 0.01 --tolerance 0.02",
    ),
    "capture": (
        "accelcal capture /dev/ttyUSB0 -o data.csv",
        "accelcal capture COM3 --baud 9600 --unit g -o data.csv",
    ),
    "plan": (
        "accelcal plan",
        "accelcal plan data.csv --add 3 --fixture faces",
        "accelcal plan result.yaml --poses 30",
    ),
    "fleet": (
        "accelcal fleet fleet.csv",
        "accelcal fleet fleet.csv --tolerance 0.02 -o results.csv",
        "accelcal fleet data.csv new.csv -o results/",
    ),
    "report": (
        "accelcal report result.yaml -o page.html",
        "accelcal report result.yaml --certificate --meta serial=A17 -o certificate.html",
    ),
    "export": (
        "accelcal export result.yaml --to c-header -o calibration.h",
        "accelcal export result.yaml --to px4 --driver-scale 1670 -o imu.params",
    ),
    "benchmark": ("accelcal benchmark --func rosenbrock --optimizer de-pso,pso,de --runs 5",),
    "compare": ("accelcal compare --runs 5 --optimizer de-pso,levenberg-marquardt",),
    "reproduce": ("accelcal reproduce", "accelcal reproduce dpso-figure2 --runs 5"),
    "optimizers": ("accelcal optimizers", "accelcal optimizers de-pso"),
    "navigate": ("accelcal navigate --filter pf,reference --runs 2 --particles 50 --period 600",),
}
"""Command lines of each command, which the tests run."""
