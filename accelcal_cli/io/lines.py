"""Lines of words and numbers, as sketches print them: ``AcX = 12 | AcY = -5``, ``Raw: 1, 2, 3``, ``#A-R=1,2,3``.

Lines are of one kind when nothing but their numbers differs. `find_filter` finds the kind that holds acceleration among
those of a sample, and `LineKind.row` its numbers in a line; files and live streams use the same. The text logs of
ArduPilot say themselves, in their FMT lines, what the numbers of each kind are (`find_messages`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from accelcal_cli.errors import DataError
from accelcal_cli.io.vocabulary import AXES, FORCE_UNITS, describe, parse_unit

if TYPE_CHECKING:
    from accelcal_cli.sensor.vehicle import VehicleCorrection

RARE = 0.02
"""Part of the lines of a sample below which a kind is an accident."""

MOST_WORDED = 0.9
"""Part of the lines with words and too few numbers from which on they are no table either."""

SHOWN = 5
"""Kinds that a message names at most."""

COLUMNS_OF_NINE = ("ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz")
"""What nine numbers behind one word are, as in the ``Raw:`` lines that MotionCal reads."""

MESSAGES = ("IMU", "ACC")
"""Messages of ArduPilot that are taken first, in this order."""

FORCE_COLUMNS = ("AccX", "AccY", "AccZ")

MESSAGE_UNITS = {
    "TimeUS": "us",
    "SampleUS": "us",
    "TimeMS": "ms",
    "T": "degC",
    "Temp": "degC",
    **dict.fromkeys(FORCE_COLUMNS, "m/s^2"),
    **dict.fromkeys(("GyrX", "GyrY", "GyrZ"), "rad/s"),
}
"""Units of the columns of ArduPilot's messages of inertial sensors."""

_SENSOR = re.compile(r"(IMU|ACC)(?:\[(\d+)\]|(\d+))?", re.IGNORECASE)
_FORMAT = re.compile(rb"^FMT,\s*\d+,\s*\d+,\s*(\w+),\s*\w*,(.*)$", re.MULTILINE)
_VALUE = re.compile(
    r"(?P<clock>(?<![\w.:])(?:\d{4}[-/]\d\d[-/]\d\d[T ])?\d{1,2}:\d\d:\d\d(?:[.,:]\d+)?(?!\w|[.:]\d))"
    r"|(?P<number>(?<![\w.^/])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.]))"
)
_CLOCK = re.compile(r"\s*((?:\d{4}[-/]\d\d[-/]\d\d[T ])?\d{1,2}:\d\d:\d\d(?:[.,:]\d+)?)(?!\w|[.:]\d)[\s:>-]*")
"""The time that terminal programs write before each line."""

_CHECKSUM = re.compile(r"\*[0-9A-Fa-f]{2}\s*$")
_BETWEEN = re.compile(r"[\s,;:=|()\[\]{}<>\"'>-]+")


@dataclass(frozen=True)
class LineKind:
    """A kind of line.

    Attributes:
        lead: the words before its first number; name: these, or those behind a time, by which it is called.
        words: lower case, between the numbers.
        labels: a name for each number, "" where it has none; units: the unit behind it, "" where there is none.
        share: its part of the sample.
    """

    lead: str
    name: str
    words: tuple[str, ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    share: float = 0.0

    @property
    def acceleration(self) -> bool:
        """Whether some of its numbers are acceleration by their words."""
        means = [describe(label) for label in self.labels if label]
        known = [unit for unit in self.units if parse_unit(unit) in FORCE_UNITS]
        razor = self.lead.strip(" #=:").upper() in ("A-R", "A-C", "A-RC")
        return razor or len(known) >= 3 or sum(m.quantity == "acceleration" for m in means) >= 1

    @property
    def names(self) -> tuple[str, ...] | None:
        """Names of the numbers; None where words do not tell them apart."""
        if len(self.labels) == 9 and not any(self.labels[1:]):
            return COLUMNS_OF_NINE
        if len(self.labels) == 3 and self.acceleration and not any(self.labels[1:]):
            return tuple(f"a{axis}" for axis in AXES)
        return self.labels if all(self.labels) and len(set(self.labels)) == len(self.labels) else None

    def row(self, line: str) -> list[str] | None:
        """Return the numbers of a line of this kind as text, None for a line of another kind."""
        words, values = _parts(line)
        return values if len(values) == len(self.labels) and tuple(words) == self.words else None

    def begins(self, line: str) -> bool:
        """Return whether a line begins as this kind does, so that it is a broken one where `row` finds nothing."""
        return bool(self.lead) and line.lstrip().lower().startswith(self.lead.lower())


@dataclass(frozen=True)
class LineFilter:
    """The lines of one kind as rows of comma-separated numbers.

    Attributes:
        prefix: what a line must begin with, taken off; kind: of the lines.
        kinds: all kinds of the sample, the commonest first.
    """

    correction: ClassVar[VehicleCorrection | None] = None
    kind: LineKind
    kinds: tuple[LineKind, ...]
    prefix: str = ""

    def translate(self, block: bytes) -> bytes:
        """Return a block of lines as rows: one line each, empty where it is of another kind."""
        lines = block.decode("utf-8", errors="replace").split("\n")
        return "\n".join(map(self._row, lines)).encode()

    def values(self, line: str) -> list[str] | None:
        """Return the numbers of a line as text, None where it is not of this kind."""
        rest = without_prefix(line, self.prefix)
        return None if rest is None else self.kind.row(rest)

    def notes(self) -> tuple[str, ...]:
        """Say what was taken of lines of several kinds, nothing where there is one."""
        others = [called(kind) for kind in self.kinds if kind is not self.kind]
        if not others:
            return ()
        return (
            f"lines are of several kinds: {called(self.kind)} taken, {', '.join(others[:SHOWN])} left out; "
            "--line PREFIX takes others",
        )

    def _row(self, line: str) -> str:
        rest = without_prefix(line.rstrip("\r"), self.prefix)
        if rest is None:
            return ""
        values = self.kind.row(rest)
        if values is not None:
            return ",".join(value.replace(",", ".") if ":" in value else value for value in values)
        return rest if self.kind.begins(rest) else ""


@dataclass(frozen=True)
class MessageFilter:
    """The lines of one message of an ArduPilot log, without its name, as comma-separated rows.

    Attributes:
        message: its name; columns: as its FMT line names them; others: messages with acceleration that are left out.
        instance: the only value of the column I that is read, None for all.
        correction: what ArduPilot had done to the readings.
    """

    message: str
    columns: tuple[str, ...]
    others: tuple[str, ...] = ()
    instance: int | None = None
    correction: VehicleCorrection | None = None

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the columns, "" where they are unknown."""
        return tuple(MESSAGE_UNITS.get(name, "") for name in self.columns)

    def translate(self, block: bytes) -> bytes:
        """Return a block of lines as rows: one line each, empty where it is of another message."""
        lead = f"{self.message},".encode()
        lines = block.split(b"\n")
        rows = [line[len(lead) :].lstrip() if line.startswith(lead) else b"" for line in lines]
        if self.instance is not None:
            at, own = self.columns.index("I"), b"%d" % self.instance
            cells = (row.split(b",", at + 1) for row in rows)
            met = [len(cell) > at and cell[at].strip() == own for cell in cells]
            rows = [row if is_own else b"" for row, is_own in zip(rows, met, strict=True)]
        return b"\n".join(rows)

    def notes(self) -> tuple[str, ...]:
        """Say which message was taken, and what ArduPilot had done to the readings."""
        others = f", {', '.join(self.others)} left out; --line NAME takes others" if self.others else ""
        taken = f"ArduPilot log: message {self.message} taken by its FMT line{others}"
        return (taken,) if self.correction is None else (taken, self.correction.in_words())


def find_messages(
    head: bytes, source: str, wanted: str | None = None, accelerometer: str | None = None
) -> MessageFilter | None:
    """Return the filter of an ArduPilot log, None for any other text.

    Args:
        head: first bytes; source: named in messages; wanted: name of the message to take, None to find it.
        accelerometer: the one to take, such as IMU2 or IMU[1], None to find it.

    Raises:
        DataError: a log without such a message, or with several accelerometers and none stated.
    """
    formats = {
        match[1].decode(): tuple(name.strip() for name in match[2].decode(errors="replace").split(","))
        for match in _FORMAT.finditer(head)
    }
    if not formats:
        return None
    able = [name for name, columns in formats.items() if set(FORCE_COLUMNS) <= set(columns)]
    able = [name for name in able if re.search(rb"^%s," % name.encode(), head, re.MULTILINE)]
    able.sort(key=lambda name: (MESSAGES.index(name) if name in MESSAGES else len(MESSAGES), name))
    if wanted is None and not able:
        raise DataError(
            f"{source}: is an ArduPilot log without messages of acceleration (IMU or ACC); log them with LOG_BITMASK"
        )
    instance = None
    if accelerometer is not None:
        names = [name for message in able for name in _accelerometers(head, message, formats[message])]
        message, bracket, number = choose_message(source, names, accelerometer).partition("[")
        instance = int(number[:-1]) if bracket else None
    else:
        message = choose_message(source, able, None) if wanted is None else wanted.strip(" ,")
    if message not in formats:
        raise DataError(
            f'{source}: no FMT line defines a message "{message}" (--line); acceleration is in {" or ".join(able)}'
        )
    others, columns = tuple(name for name in able if name != message), formats[message]
    shown = _accelerometers(head, message, columns) if instance is None else [f"{message}[{instance}]"]
    # The rows of several are refused later, unless --where chooses among them.
    correction = _correction(head, shown[0]) if len(shown) == 1 and message in able else None
    return MessageFilter(message, columns, others, instance, correction)


def _accelerometers(head: bytes, message: str, columns: Sequence[str]) -> list[str]:
    """Return the accelerometers whose rows one kind of message has, by the column I where there is one."""
    if "I" not in columns:
        return [message]
    lines = re.findall(rb"^%s,(.*)$" % message.encode(), head, re.MULTILINE)
    cells = (line.split(b",") for line in lines)
    at = columns.index("I")
    numbers = {row[at].strip() for row in cells if len(row) > at}
    return [f"{message}[{int(number)}]" for number in sorted(numbers) if number.isdigit()]


def _correction(head: bytes, name: str) -> VehicleCorrection:
    """Return what ArduPilot had done to the readings of an accelerometer, by the PARM lines."""
    from accelcal_cli.io.formats.ardupilot import correction_by

    match = _SENSOR.fullmatch(name)
    instance = 0 if match is None else int(match[2] or int(match[3] or 1) - 1)

    parameters: dict[str, float] = {}
    changed: set[str] = set()
    for found in re.finditer(
        rb"^PARM,[^\n]*?\b((?:INS_|AHRS_)\w+),\s*([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)", head, re.MULTILINE
    ):
        label, value = found[1].decode(), float(found[2])
        if parameters.setdefault(label, value) != value:
            changed.add(label)
    return correction_by(parameters, changed, instance)


def choose_message(source: str, names: Sequence[str], wanted: str | None) -> str:
    """Return the accelerometer of an ArduPilot log to read: those of IMU messages go before those of ACC messages.

    Args:
        source: named in messages; names: IMU, IMU2, ACC1, ... or, by the column I, IMU[0], IMU[1], ACC[0], ...
        wanted: option --accelerometer; IMU2 and IMU[1] are the same.

    Raises:
        DataError: none, or several and none wanted. UsageError: no such one.
    """
    from accelcal_cli.io.formats.base import choose_accelerometer

    if wanted is None:
        first = next((kind for kind in MESSAGES if any(name.startswith(kind) for name in names)), "")
        return choose_accelerometer(source, [name for name in names if name.startswith(first)], None)
    if match := _SENSOR.fullmatch(wanted.strip()):
        kind, k = match[1].upper(), int(match[2] or int(match[3] or 1) - 1)
        numbered = match[2] or match[3]
        able = [f"{kind}[{k}]", *([] if k else [kind]), f"{kind}{k + 1}"] if numbered else [kind]
        wanted = next((name for name in able if name in names), wanted)
    return choose_accelerometer(source, names, wanted)


def called(kind: LineKind) -> str:
    """Return how a message names a kind."""
    return f'"{kind.name}"' if kind.name else f"{len(kind.labels)} bare numbers"


def without_prefix(line: str, prefix: str) -> str | None:
    """Return a line without its prefix, None for one that does not begin with it, or with a time and then with it."""
    text = line.lstrip()
    if text.startswith(prefix):
        return text[len(prefix) :]
    clock = _CLOCK.match(text)
    rest = "" if clock is None else text[clock.end() :]
    return f"{clock[1]} {rest[len(prefix) :]}" if clock is not None and rest.startswith(prefix) else None


def find_filter(lines: Sequence[str], source: str, prefix: str | None = None) -> LineFilter | None:
    """Return the filter of some lines, None where their numbers stand in no words.

    Args:
        lines: of a sample; source: named in messages.
        prefix: of the lines to take, None for the kind that holds acceleration.

    Raises:
        DataError: no line has the prefix, several kinds may be acceleration, or each axis has a line of its own.
    """
    kept = lines
    if prefix is not None:
        rests = [without_prefix(line, prefix) for line in lines]
        kept = [rest for rest in rests if rest is not None]
        if not kept:
            found = ", ".join(called(kind) for kind in _kinds(lines)[:SHOWN]) or "no lines with numbers"
            raise DataError(f'{source}: no line begins with "{prefix}" (--line); there are {found}')
    kinds = _kinds(kept)
    able = [kind for kind in kinds if len(kind.labels) >= 3]
    if not able and sum(kind.share for kind in kinds if kind.name) > MOST_WORDED:
        shown = ", ".join(called(kind) for kind in kinds[:SHOWN])
        raise DataError(
            f"{source}: no line has three numbers; lines are of the kinds {shown}; x, y and z have to stand in one line"
        )
    if prefix is None and not any(kind.name or any(kind.labels) for kind in able):
        return None
    chosen = [kind for kind in able if kind.acceleration] or able
    if not chosen:
        return None
    if len(chosen) > 1 and prefix is None:
        shown = " or ".join(called(kind) for kind in chosen[:SHOWN])
        raise DataError(
            f"{source}: lines are of several kinds, and the readings could be {shown}; say which with --line, as in "
            f'--line "{chosen[0].name or "PREFIX"}"'
        )
    return LineFilter(chosen[0], tuple(kinds), prefix or "")


def _kinds(lines: Sequence[str]) -> list[LineKind]:
    """Return the kinds of lines with numbers, the commonest first, without those that occur once where others recur."""
    counts: dict[tuple[tuple[str, ...], int], tuple[int, str]] = {}
    for line in lines:
        words, values = _parts(line)
        key = tuple(words), len(values)
        if values:
            counts[key] = counts.get(key, (0, line))[0] + 1, counts.get(key, (0, line))[1]
    often = max((count for count, _ in counts.values()), default=0)
    least = max(2 if often > 2 else 1, RARE * len(lines))
    return [
        _kind(line, count / len(lines))
        for count, line in sorted(counts.values(), key=lambda item: -item[0])
        if count >= least
    ]


def _parts(line: str) -> tuple[list[str], list[str]]:
    """Return the words around the numbers of a line, one more than numbers, and the numbers as text."""
    words, values, at = [], [], 0
    line = _CHECKSUM.sub("", line)
    for match in _VALUE.finditer(line):
        words.append(_normal(line[at : match.start()]))
        values.append(match[0])
        at = match.end()
    return [*words, _normal(line[at:])], values


def _normal(text: str) -> str:
    return " ".join(text.lower().split())


def _kind(line: str, share: float) -> LineKind:
    line = _CHECKSUM.sub("", line)
    matches = list(_VALUE.finditer(line))
    labels: list[str] = []
    units: list[str] = []
    family = ""
    for k, match in enumerate(matches):
        before = line[matches[k - 1].end() if k else 0 : match.start()]
        behind = line[match.end() : matches[k + 1].start() if k + 1 < len(matches) else len(line)]
        words = [word for word in _BETWEEN.split(before) if word]
        if k and words and (parse_unit(words[0]) in FORCE_UNITS) and units[-1:] == [words[0]]:
            words = words[1:]
        label = " ".join(words[-3:])
        meaning = describe(label) if label else None
        if meaning is not None and meaning.axis is not None and meaning.family:
            family = label.rsplit(" ", 1)[0] if " " in label else ""
        elif meaning is not None and meaning.axis is not None and family:
            label = f"{family} {label}"
        labels.append("time" if match["clock"] and not label else label)
        tail = [word for word in re.split(r"[\s,;|]+", behind.strip()) if word]
        units.append(tail[0] if tail and parse_unit(tail[0]) else "")
    if units and parse_unit(units[-1]) in FORCE_UNITS:  # one unit behind the last number is that of all
        units = [unit or units[-1] for unit in units]
    lead = name = line[: matches[0].start()].strip()
    if not lead and matches[0]["clock"] and len(matches) > 1:
        name = line[matches[0].end() : matches[1].start()].strip(" \t:>-")
    return LineKind(lead, name, tuple(_parts(line)[0]), tuple(labels), tuple(units), share)
