"""The application: its commands, and the one place where errors become messages and exit codes."""

from __future__ import annotations

import errno
import os
import sys
from typing import Annotated

import typer

from accelcal_cli import __version__
from accelcal_cli.cli import calibrate, simulate
from accelcal_cli.errors import AccelcalError

BAD_INPUT, INTERRUPTED = 2, 130

for library in ("OPENBLAS", "OMP", "MKL"):
    # Our matrices are small: threads only wait for each other, and a result must not depend on their number.
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

app = typer.Typer(
    name="accelcal",
    help="Calibrate three-axis accelerometers without a turntable.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("calibrate")(calibrate.command)
app.command("simulate")(simulate.command)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"accelcal {__version__}")
        raise typer.Exit()


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Calibrate three-axis accelerometers without a turntable."""


def main() -> None:
    """Run the command line; exit 0 done, 1 done with a bad verdict, 2 bad input, 130 interrupted."""
    try:
        app()
    except AccelcalError as error:
        _fail(str(error), BAD_INPUT)
    except KeyboardInterrupt:
        _fail("interrupted", INTERRUPTED)
    except BrokenPipeError:
        _leave_pipe()
    except OSError as error:
        if error.errno == errno.EPIPE:
            _leave_pipe()
        _fail(f"cannot write: {(error.strerror or str(error)).lower()}", BAD_INPUT)
    except MemoryError:
        _fail("not enough memory for this input", BAD_INPUT)


def _fail(message: str, code: int) -> None:
    typer.echo(f"accelcal: {message}", err=True)
    sys.exit(code)


def _leave_pipe() -> None:
    """Leave quietly when the reader of our output has gone, as `head` does."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(0)
