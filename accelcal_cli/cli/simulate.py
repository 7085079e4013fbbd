"""`accelcal simulate`: readings of a sensor whose errors are known."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

from accelcal_cli.cli import options
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from accelcal_cli.arrays import Float
    from accelcal_cli.sensor.model import ErrorModel
    from accelcal_cli.sensor.simulation import Sensor, SimulatedReadings

MOST_SAMPLES = 100_000_000

in_sensor, in_poses = options.panel("Sensor"), options.panel("Poses")


def command(
    *,
    sensor: Annotated[
        str,
        in_sensor(
            help="Type of the sensor: {choices}, or a YAML file.",
            autocompletion=options.one_of(partial(options.shipped, "sensors")),
        ),
    ] = "dpso",
    sensors: Annotated[
        int | None, in_sensor(help="Sensors of this type, drawn with its spread, for `fleet`.", min=1)
    ] = None,
    noise: Annotated[
        float | None,
        in_sensor(
            help="Noise of one sample and axis, one sigma, m/s^2.",
            show_default="the sensor's",
            callback=options.check_noise,
        ),
    ] = None,
    seed: Annotated[int, in_sensor(help="Seed of all random numbers.", min=0)] = 0,
    positions: Annotated[int, in_poses(help="Number of poses.", min=1, max=MOST_SAMPLES)] = 12,
    scheme: Annotated[
        str | None,
        in_poses(help="Where the poses point: {choices}.", autocompletion=options.one_of(options.SCHEMES)),
    ] = None,
    samples: Annotated[int, in_poses(help="Samples per pose.", min=1)] = 1,
    attitude: Annotated[bool, in_poses(help="Add the true specific force of each row.")] = False,
    gravity: options.GravityOptions,
    raw: Annotated[
        bool, options.in_log("--raw", help="Simulate a raw log: poses held, moves between.")
    ] = False,
    rate: Annotated[
        float | None, options.in_log(help="With --raw: rows per second.", show_default="100")
    ] = None,
    hold: Annotated[
        float | None, options.in_log(help="With --raw: seconds per pose.", show_default="5")
    ] = None,
    move: Annotated[
        float | None, options.in_log(help="With --raw: seconds per move.", show_default="2")
    ] = None,
    tremor: Annotated[
        float | None, options.in_log(help="With --raw: tremor of the hand, m/s^2 rms.", show_default="0")
    ] = None,
    gyro: Annotated[bool, options.in_log("--gyro", help="With --raw: add a gyroscope, rad/s.")] = False,
    output: Annotated[str, options.in_output("--output", "-o", help="CSV file; - is standard output.")] = "-",
    truth: Annotated[str | None, options.in_output(help="YAML file for the true parameters.")] = None,
    quiet: options.Quiet = False,
) -> None:
    """Simulate static readings of a sensor with known errors.

    With several samples per pose the rows carry the label of their pose, and `calibrate` averages them. With
    --sensors they carry the label of their sensor, and `fleet` calibrates each. With --raw they are a log of time,
    acceleration and, with --gyro, turning rate, in which `detect` finds the poses.
    """
    from accelcal_cli.config import dump
    from accelcal_cli.output.files import whole_file
    from accelcal_cli.output.machine import write_log
    from accelcal_cli.rng import Purpose, Streams
    from accelcal_cli.schema import from_mapping
    from accelcal_cli.sensor.model import STANDARD_GRAVITY
    from accelcal_cli.sensor.poses import directions
    from accelcal_cli.sensor.simulation import Handling, load_sensor, simulate, simulate_fleet, simulate_log

    if raw and sensors is not None:
        raise UsageError("--sensors cannot be used with --raw")
    if positions * samples * (sensors or 1) > MOST_SAMPLES:
        many = "" if sensors is None else f" and --sensors {sensors}"
        raise UsageError(
            f"--positions {positions} with --samples {samples}{many}: at most {MOST_SAMPLES:,} rows"
        )
    if output == truth:
        raise UsageError(f'--truth "{truth}": expected another file than --output')
    stated = options.stated(rate=rate, hold=hold, move=move, tremor=tremor)
    if not raw and (stated or gyro):
        raise UsageError(f"--{next(iter(stated), 'gyro')} needs --raw")
    if raw and (samples > 1 or attitude):
        raise UsageError(f"{'--samples' if samples > 1 else '--attitude'} cannot be used with --raw")
    shipped = not Path(sensor).suffix
    options.check_files([None if shipped else sensor], {"-o": output, "--truth": truth})
    local_g = gravity.stated() or STANDARD_GRAVITY
    device = load_sensor(sensor)
    u = directions(positions, scheme, Streams(seed, [0], Purpose.ATTITUDE).normal(positions, 3)[0])
    sigma = device.noise if noise is None else noise
    record = _truth(device, local_g, sigma, u)
    with whole_file(output) as file:
        if raw:
            log = simulate_log(
                device, u, local_g, from_mapping(Handling, stated, "simulate --raw"), sigma, seed
            )
            record["holds"] = [list(rows) for rows in write_log(log, gyro, file)]
        elif sensors is not None:
            drawn = simulate_fleet(device, sensors, u, local_g, samples, sigma, seed)
            record["sensors"] = _write_fleet(file, drawn, len(str(sensors)), samples > 1, attitude)
        else:
            _header(file, [], samples > 1, attitude)
            _write(file, simulate(device, u, local_g, samples, sigma, seed), samples > 1, attitude)
    sys.stdout.flush()
    if truth is not None:
        with whole_file(truth) as file:
            file.write(dump(record))
    options.tell_written([output, truth], quiet)


def _header(file: IO[str], first: list[str], labelled: bool, attitude: bool) -> None:
    names = first + ["pose"] * labelled + ["Nx", "Ny", "Nz"] + ["fx", "fy", "fz"] * attitude
    file.write(",".join(names) + "\n")


def _write_fleet(
    file: IO[str],
    drawn: Iterable[tuple[ErrorModel, SimulatedReadings]],
    digits: int,
    labelled: bool,
    attitude: bool,
) -> dict[str, object]:
    """Write the rows of many sensors; return the true parameters by sensor."""
    truth: dict[str, object] = {}
    _header(file, ["sensor"], labelled, attitude)
    for number, (model, readings) in enumerate(drawn, 1):
        label = f"S{number:0{digits}d}"
        truth[label] = {"K_a": model.K.tolist(), "D_a": model.D.tolist()}
        _write(file, readings, labelled, attitude, f"{label},")
    return truth


def _write(
    file: IO[str], readings: SimulatedReadings, labelled: bool, attitude: bool, first: str = ""
) -> None:
    """Write the rows with the shortest digits that read back to the same numbers, each after the text `first`."""
    for pose, output, force in zip(readings.pose, readings.output, readings.force, strict=True):
        cells = [str(pose)] * labelled + [repr(float(v)) for v in output]
        if attitude:
            cells += [repr(float(v)) for v in force]
        file.write(f"{first}{','.join(cells)}\n")


def _truth(device: Sensor, g: float, noise: float, u: Float) -> dict[str, object]:
    """Return the true parameters, as configured and in gauge `lower`."""
    model = device.model
    return {
        "sensor": device.name,
        "unit": device.unit,
        "g": g,
        "noise": noise,
        "K_a": model.K.tolist(),
        "D_a": model.D.tolist(),
        "K_a_lower": model.in_gauge("lower").K.tolist(),
        "directions": u.tolist(),
    }
