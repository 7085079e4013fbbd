"""The option --meta: what a result keeps of the sensor, the operator, the day."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from typing import Annotated

from accelcal_cli.cli import options

OPTION = "--meta"

Meta = Annotated[
    list[str] | None,
    options.in_output(
        OPTION,
        help="Keep this with the result, as serial=A17 operator=Jo temperature=21; repeatable.",
        metavar="KEY=VALUE ...",
    ),
]


def stated(pairs: list[str] | None) -> dict[str, str]:
    """Return what --meta states, see `provenance.parse_meta`."""
    from accelcal_cli.calibration.provenance import parse_meta

    return parse_meta(pairs or [])


def spread(arguments: Sequence[str]) -> Iterator[str]:
    """Yield arguments with `--meta A=1 B=2` as `--meta A=1 --meta B=2`; a file that has such a name stays one.

    >>> list(spread(["data.csv", "--meta", "serial=7", "operator=Jo", "-q"]))
    ['data.csv', '--meta', 'serial=7', '--meta', 'operator=Jo', '-q']
    """
    before = ("", "")
    for argument in arguments:
        further = before[0] == OPTION or before[1].startswith(f"{OPTION}=")
        if further and re.match(r"[^\W\d_][\w.-]*=", argument) and not os.path.exists(argument):
            yield OPTION
            before = (OPTION, argument)
        else:
            before = (before[1], argument)
        yield argument
