"""YAML that is small and means much, or ends in an error of Python's own."""

import pickle
import time

import pytest
import yaml

from ctlev_core.plugins import PluginError
from ctlev_core.sensor import options as sensor
from data_contracts import yaml_text
from data_contracts.errors import DataError, DetailedDataError, shortened
from flows.command_line import apply_override, load_experiment
from flows.studies import load_study

BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "\n".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
HOSTILE = {
    "aliases of aliases": BOMB,
    "merged aliases": "a: &a {b: 1}\n" + "c: &c [" + "*a," * 1000 + "]\n" + "d: [" + "*c," * 100 + "]",
    "an alias within itself": "a: &a [*a]",
    "deep lists": "a: " + "[" * 20_000 + "]" * 20_000,
    "deep mappings": "a: " + "{a: " * 20_000 + "1" + "}" * 20_000,
    "deep blocks": "\n".join(" " * depth + "a:" for depth in range(500)),
    "a long number": "seed: " + "9" * 10_000,
    "a long negative number": "seed: -" + "9" * 10_000,
    "a long hexadecimal number": "seed: 0x" + "f" * 5_000,
    "a long float": "seed: 1." + "9" * 10_000,
    "a date that is none": "name: 2026-13-45",
    "a list as a key": "? [a]\n: b",
    "a mapping as a key": "{{a: b}: c}",
    "numbers as keys": "1: 2\n3: 4",
    "a long text": "name: [" + "x" * 100_000 + "]",
    "a long key": "x" * 100_000 + ": 1",
    "many keys": "\n".join(f"key{number}: 1" for number in range(5_000)),
    "an unclosed list": "[" * 20_000,
    "too long": "# " + "x" * 2_000_000,
    "an object of Python": "name: !!python/object/apply:os.system [true]",
    "a null byte": "name: \0",
}


@pytest.mark.parametrize("kind", HOSTILE)
@pytest.mark.parametrize("load", [load_experiment, load_study])
def test_hostile_presets_end_soon_in_a_short_error(tmp_path, kind, load):
    path = tmp_path / "hostile.yaml"
    path.write_text(HOSTILE[kind])
    started = time.monotonic()
    with pytest.raises(PluginError, match=r"hostile\.yaml") as refused:
        load(str(path), [])
    assert time.monotonic() - started < 5 and len(str(refused.value)) <= 2_000
    with pytest.raises(DataError, match=r"hostile\.yaml") as refused:
        sensor.read_preset(path)
    assert len(str(refused.value)) <= 2_000


@pytest.mark.parametrize("text", ["[" * 20_000, "9" * 10_000, BOMB, "x" * 100_000])
def test_hostile_options_of_the_command_line_too(text):
    with pytest.raises(PluginError) as refused:
        load_experiment("smoke", [f"windows.num_events={text}"])
    assert len(str(refused.value)) < 500
    with pytest.raises(PluginError, match="expects key=value") as refused:
        apply_override({}, text.replace("=", ""))
    assert len(str(refused.value)) < 500


def test_aliases_and_merges_of_a_reasonable_size_are_read():
    assert yaml_text.load_yaml("a: &a {b: 1}\nc: {<<: *a, d: 2}\ne: [*a, *a]") == {
        "a": {"b": 1},
        "c": {"b": 1, "d": 2},
        "e": [{"b": 1}, {"b": 1}],
    }
    deep = "[" * 49 + "]" * 49
    assert repr(yaml_text.load_yaml(deep)) == deep
    with pytest.raises(yaml.YAMLError, match="nested more than 50 levels deep"):
        yaml_text.load_yaml("[" * 51 + "]" * 51)


def test_a_message_keeps_its_beginning_and_its_end():
    text = shortened("place: " + "x" * 5_000 + " cause")
    assert len(text) == 2_000 and text.startswith("place: ") and text.endswith(" cause") and " ... " in text
    assert shortened("short") == "short"
    assert len(str(DataError("x" * 10_000))) == 499
    assert str(pickle.loads(pickle.dumps(DetailedDataError("x" * 1_000)))) == "x" * 1_000
