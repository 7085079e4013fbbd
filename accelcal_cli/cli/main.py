"""The application: its commands, and the one place where errors become messages and exit codes."""

from __future__ import annotations

import dataclasses
import errno
import inspect
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib import import_module
from typing import Annotated, Any, NoReturn, get_args, get_type_hints

import typer
import typer.core
import typer.main

from accelcal_cli import __version__
from accelcal_cli.cli import process
from accelcal_cli.errors import AccelcalError, Interrupted, visible

BAD_INPUT, INTERRUPTED = 2, 130
CHOICES = "{choices}"
"""Stands in a help text for the choices that an option offers to the shell."""

for library in ("OPENBLAS", "OMP", "MKL"):
    # Our matrices are small: threads only wait for each other, and a result must not depend on their number.
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

BadUsage: type[Exception] = typer.BadParameter.__bases__[0]
"""What typer raises for an unknown command or option, or a value of the wrong type."""


NAMES = (
    "calibrate",
    "simulate",
    "detect",
    "apply",
    "verify",
    "capture",
    "plan",
    "fleet",
    "report",
    "export",
    "benchmark",
    "compare",
    "reproduce",
    "optimizers",
    "navigate",
)
"""The commands in the order of the help page; each is the function `command` of the module of its name."""

STYLE: dict[str, Any] = {
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
"""What the program and every command of it are made with; help without rich, whose import takes as long as all else."""


@cache
def _build(name: str) -> Any:
    """Return the parsed form of one command."""
    alone = typer.Typer(add_completion=False, **STYLE)
    alone.command(name, cls=Command)(expand(_function(name)))
    return typer.main.get_command(alone)


def _function(name: str) -> Any:
    return import_module(f"accelcal_cli.cli.{name}").command


def expand(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command as typer wants it: every group of options spelled out as the options themselves.

    A parameter stands for a group when its type is a dataclass, or when its annotation carries a function that returns
    one (`Annotated[Any, function]`), for options that are known only when they are asked for.
    """
    groups: dict[str, Any] = {}
    spelled: dict[str, inspect.Parameter] = {}
    hints = get_type_hints(command, include_extras=True)
    for parameter in inspect.signature(command).parameters.values():
        hint = hints[parameter.name]
        makers = [part for part in get_args(hint)[1:] if inspect.isfunction(part)]
        group = makers[0]() if makers else hint
        if not dataclasses.is_dataclass(group):
            spelled[parameter.name] = parameter.replace(annotation=hint, kind=parameter.KEYWORD_ONLY)
            continue
        groups[parameter.name] = group
        own = get_type_hints(group, include_extras=True)
        for field in dataclasses.fields(group):
            spelled[field.name] = inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=own[field.name]
            )

    def run(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{f.name: values.pop(f.name) for f in dataclasses.fields(group)})
        command(**values)

    run.__doc__ = command.__doc__
    run.__signature__ = inspect.Signature(list(spelled.values()))  # type: ignore[attr-defined]
    return run


def help_text(parameter: Any, ctx: Any, text: str) -> str:
    """Return the help of a parameter with its choices in place of {choices}.

    Without the parentheses that typer puts round a default that is a text.
    """
    text = re.sub(r"default: \((.*)\)(?=[;\]])", r"default: \1", text)
    if CHOICES not in text:
        return text
    names = [item.value for item in parameter.shell_complete(ctx, "")]
    return text.replace(CHOICES, " or ".join(filter(None, (", ".join(names[:-1]), names[-1]))))


class Command(typer.core.TyperCommand):
    """A command whose help has its options under the headings of their panels, with their choices."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the arguments, of which `--meta` takes several."""
        if any(word.startswith("--meta") for word in args):
            from accelcal_cli.cli.meta import spread

            args = list(spread(args))
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a list for each panel, in the order of their first options; what has no panel comes last."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                names, text = record
                heading = getattr(parameter, "rich_help_panel", None) or "Options"
                row = names, help_text(parameter, ctx, text)
                panels.setdefault(heading, []).append(row)
        for heading, rows in panels.items():
            with formatter.section(heading):
                formatter.write_dl(rows)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002  # typer's signature
        """Write examples."""
        from accelcal_cli.cli.examples import EXAMPLES

        with formatter.section("Examples"):
            for example in EXAMPLES[self.name or ""]:
                formatter.write(f"  {example}\n")


class LazyCommands(Mapping[str, Any]):
    """The commands by name, each imported and built when it is asked for: a calibration pays for no other."""

    def __getitem__(self, name: str) -> Any:
        """Return a command."""
        if name not in NAMES:
            raise KeyError(name)
        return _build(name)

    def __iter__(self) -> Iterator[str]:
        """Go through the names."""
        return iter(NAMES)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(NAMES)


class Commands(typer.core.TyperGroup):
    """The commands; keeps typer from taking a reader that left (`| head -1`) for a failure, or a signal for Ctrl-C."""

    def __init__(self, **attributes: Any) -> None:
        """Make the group of all commands."""
        super().__init__(**attributes)
        self.commands = LazyCommands()  # type: ignore[assignment]  # only ever read

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002  # typer's signature
        """Write the commands, each with the first line of its docstring, without building any."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, _function(name).__doc__.partition("\n")[0]) for name in NAMES])

    def invoke(self, ctx: Any) -> Any:
        """Run a command; leave quietly when the reader of its output has gone."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            raise process.interrupted(stop) from None
        except BrokenPipeError:
            _leave_pipe()


app = typer.Typer(
    name="accelcal",
    cls=Commands,
    help="Calibrate three-axis accelerometers without a turntable.",
    **STYLE,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"accelcal {__version__}")
        raise typer.Exit()


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Calibrate three-axis accelerometers without a turntable."""


COMPLETION = "_ACCELCAL_COMPLETE"
"""Set by a shell that asks how a command line may go on."""


def main() -> None:
    """Run the command line; exit 0 done, 1 done with a bad verdict, 2 bad input, 128 + n by signal n."""
    _open_streams()
    if sys.argv[1:] in ([], ["help"]) and COMPLETION not in os.environ:
        _guide()
    if sys.argv[1:2] == ["help"]:
        sys.argv[1:] = [*sys.argv[2:], "--help"]
    try:
        with process.raised():
            code = app(prog_name="accelcal", standalone_mode=False)
    except AccelcalError as error:
        _fail(str(error), BAD_INPUT)
    except BadUsage as error:
        _explain(error)
    except Interrupted as error:
        _fail(str(error), error.code)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except BrokenPipeError:
        _leave_pipe()
    except OSError as error:
        if error.errno == errno.EPIPE:
            _leave_pipe()
        process.drop(sys.stdout)
        _fail(f"cannot write: {(error.strerror or str(error)).lower()}", BAD_INPUT)
    except MemoryError:
        _fail("not enough memory for this input", BAD_INPUT)
    if code == INTERRUPTED:
        _fail("interrupted", INTERRUPTED)
    sys.exit(code)


def _guide() -> NoReturn:
    """Print how to begin."""
    from accelcal_cli.cli.examples import GUIDE

    try:
        sys.stdout.write(GUIDE)
        sys.stdout.flush()
    except BrokenPipeError:
        _leave_pipe()
    sys.exit(0)


def _explain(error: Any) -> NoReturn:
    """Print what is wrong with the command line in one line."""
    command = error.ctx.command_path if error.ctx else "accelcal"
    text = error.format_message().rstrip(".")
    _fail(f"{text[:1].lower()}{text[1:]} (see {command} --help)", BAD_INPUT)


def _open_streams() -> None:
    """Put the null device where a stream was closed, as by `<&-`: Python has None there. Print any text."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, open(null, mode, closefd=False))  # noqa: SIM115  # open as long as the program
    if isinstance(sys.stdout, io.TextIOWrapper):  # a label that the terminal's encoding lacks is no failure
        sys.stdout.reconfigure(errors="backslashreplace")


def _fail(message: str, code: int) -> NoReturn:
    try:
        typer.echo(visible(f"accelcal: {message}"[:4000]), err=True)
    except OSError:  # a terminal that is gone
        process.drop(sys.stderr)
    sys.exit(code)


def _leave_pipe() -> NoReturn:
    """Leave quietly when the reader of our output has gone, as `head` does."""
    process.drop(sys.stdout)
    sys.exit(0)
