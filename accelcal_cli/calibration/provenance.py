"""Where a result comes from beside its readings: what the user states of it, and a hash of its settings."""

from __future__ import annotations

import hashlib
import json
import re
import unicodedata
from collections.abc import Iterable, Mapping

from accelcal_cli.errors import ConfigError, UsageError

KEY = re.compile(r"[^\W\d_][\w.-]{0,39}")
"""The name of an entry: a letter, then letters, digits, dots, hyphens and underscores."""

LONGEST, MOST = 200, 24
"""Characters of a value, and entries of a result: as many as a certificate has room for."""


def parse_meta(pairs: Iterable[str]) -> dict[str, str]:
    """Return what is stated of a result as KEY=VALUE.

    Raises:
        UsageError: no such pair, a key twice, or a key or value that is not allowed.

    Examples:
        >>> parse_meta(["serial=A-17", "operator=Jo Smith"])
        {'serial': 'A-17', 'operator': 'Jo Smith'}
    """
    meta: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not equals:
            raise UsageError(f'--meta "{pair}": expected KEY=VALUE, as serial=A17')
        if key in meta:
            raise UsageError(f'--meta "{pair}": {key} was stated before; expected each key once')
        meta[key] = "".join(" " if unicodedata.category(c) == "Zs" else c for c in value)
    try:
        return check_meta(meta)
    except ConfigError as error:
        raise UsageError(f"--meta {error}") from None


def check_meta(meta: Mapping[str, str], where: str = "") -> dict[str, str]:
    """Return what is stated of a result once every key and value is allowed; `where` begins a message.

    Raises:
        ConfigError: a key or value that is not allowed, or too many of them.
    """
    if len(meta) > MOST:
        raise ConfigError(f"{where}{len(meta)} entries: expected at most {MOST}")
    for key, value in meta.items():
        if not isinstance(key, str) or not KEY.fullmatch(key):
            raise ConfigError(
                f'{where}"{str(key)[:60]}": expected a key of letters, digits, dots, hyphens and underscores that '
                "begins with a letter, up to 40 characters"
            )
        if bad := next((c for c in value if not c.isprintable()), None):
            raise ConfigError(f"{where}{key}: holds the character U+{ord(bad):04X}; expected printable text")
        if not 0 < len(value) <= LONGEST:
            raise ConfigError(f"{where}{key}: has {len(value)} characters; expected 1 to {LONGEST}")
    return dict(meta)


def settings_sha256(settings: Mapping[str, object]) -> str:
    """Return the SHA-256 of settings: of their JSON in UTF-8 with sorted keys and no blanks.

    Examples:
        >>> settings_sha256({"g": 9.81, "seed": 0})[:8]
        '8f341688'
    """
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
