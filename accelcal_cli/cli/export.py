"""`accelcal export`: a result in the formats that other tools read."""

from __future__ import annotations

import dataclasses
import sys
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from accelcal_cli.cli import options
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.exporters.base import Exporter

in_format = options.panel("Format")


def _takers() -> dict[str, dict[str, type[Exporter]]]:
    """Return the exporters that take an option, by option and name."""
    from accelcal_cli.exporters.base import EXPORTERS

    takers: dict[str, dict[str, type[Exporter]]] = {}
    for name in EXPORTERS.names():
        cls = EXPORTERS.get(name)
        for field in dataclasses.fields(cls):
            takers.setdefault(field.name, {})[name] = cls
    return takers


def format_options() -> type:
    """Return the group of all options of exporters, each once; the help names the exporters that take it."""
    fields = []
    for option, classes in _takers().items():
        cls = next(iter(classes.values()))
        (field,) = (field for field in dataclasses.fields(cls) if field.name == option)
        doc = field.metadata["doc"]
        default = False if field.default is None else str(field.default)
        flag = f"--{option.replace('_', '-')}"
        hint: Any = Annotated[
            get_type_hints(cls)[option] | None,
            in_format(flag, help=f"{doc[0].upper()}{doc[1:]} ({', '.join(classes)}).", show_default=default),
        ]
        fields.append((option, hint, dataclasses.field(default=None)))
    return dataclasses.make_dataclass("FormatOptions", fields, frozen=True)


def command(
    result: options.ResultFile,
    to: Annotated[
        str,
        in_format(
            "--to",
            help="Format: {choices}.",
            metavar="FORMAT",
            autocompletion=options.one_of(options.exporters),
        ),
    ],
    target: Annotated[Any, format_options],
    output: Annotated[
        str, options.in_output("--output", "-o", help="File to write; - is standard output.")
    ] = "-",
    force: options.Force = False,
    quiet: options.Quiet = False,
) -> None:
    """Write a result in the format of another tool.

    Warns of what the format cannot hold: PX4 and ArduPilot have no misalignments and no temperature slopes of the
    scale factors.
    """
    from accelcal_cli.exporters.base import EXPORTERS, export
    from accelcal_cli.output.files import whole_file

    cls = EXPORTERS.get(to)
    stated = options.stated(**vars(target))
    for option in stated:
        takers = _takers()[option]
        if to not in takers:
            raise UsageError(
                f"--{option.replace('_', '-')} does not apply to --to {to}; it applies to {', '.join(takers)}"
            )
    options.check_files([result], {"-o": output})
    if cls.binary and output == "-" and sys.stdout.isatty():
        raise UsageError(f"--to {to} is not text for a terminal; name a file with -o")
    calibration = options.load_result(result)
    calibration.check_determined(result, force=force)
    options.warn(result, calibration.warnings, quiet)
    made = export(calibration, to, force=True, **stated)
    with whole_file(output, binary=True) as file:
        file.write(made.content)
    sys.stdout.flush()
    options.tell((f"warning: {text}" for text in made.warnings), quiet)
    options.tell_written([output], quiet)
