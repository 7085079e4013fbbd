"""YAML and JSON text to mappings and back, with faults named by their place."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from accelcal_cli.config import dump, load_mapping, parse_mapping, read_text, shipped, shipped_parameters
from accelcal_cli.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "mapping"),
    [
        ("a: 1\nb: [1, 2.5]\n", {"a": 1, "b": [1, 2.5]}),
        ('{"a": 1e-05}', {"a": 1e-05}),
        ("{a: 1}", {"a": 1}),
        ("a: 1e-05", {"a": "1e-05"}),  # YAML 1.1; the schema takes it for the number that is meant
        ("a: {b: null}", {"a": {"b": None}}),
    ],
)
def test_yaml_and_json_are_read(text, mapping):
    assert parse_mapping(text, "f") == mapping


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\na: 2\n", 'f, line 2, column 1: key "a" is given twice'),
        ('{"a": 1, "a": 2}', 'f, line 1, column 10: key "a" is given twice'),
        ("1: 2\n", "f, line 1, column 1: key 1 is not text"),
        ("a: [1\n", "f, line 2, column 1: "),
        ('{"a": 1', "f, line 2, column 1: "),
        ("- 1\n", "f: expected keys and values"),
        ("", "f: expected keys and values"),
        ("a: \x00", "f: not YAML: "),
    ],
)
def test_a_fault_is_named_with_its_place(text, words):
    with pytest.raises(ConfigError) as error:
        parse_mapping(text, "f")
    assert str(error.value).startswith(words)
    assert "\n" not in str(error.value)


def test_a_file_or_standard_input_is_read(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert load_mapping(file) == {"a": 1}
    assert read_text(Path("<stdin>"), io.BytesIO(b"b: 2")) == "b: 2"
    file.write_bytes(b"a: \xff\n")
    with pytest.raises(ConfigError, match=r"a.yaml: not UTF-8 text \(byte 3\)"):
        load_mapping(file)
    with pytest.raises(ConfigError, match=r"none.yaml: no such file or directory"):
        load_mapping(tmp_path / "none.yaml")


def test_what_is_written_reads_back():
    record = {"word": "yes", "text": "1e-5", "none": None, "numbers": [[1.5e-300, 2], []], "key": {"ä": True}}
    assert parse_mapping(dump(record), "f") == record
    assert list(parse_mapping(dump({"b": 1, "a": 2}), "f")) == ["b", "a"]


def test_the_shipped_files_are_found_by_name():
    assert {"de-pso", "pso"} <= set(shipped("optimizers"))
    assert shipped("nothing") == {}
    assert shipped_parameters("de-pso")
    assert shipped_parameters("no-such-optimizer") == shipped_parameters(3) == {}
