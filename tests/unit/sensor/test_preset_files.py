"""Preset files that say something twice or are no YAML are refused, with the place; merged mappings are not."""

from pathlib import Path

import pytest

from ctlev_core.plugins import PluginError
from ctlev_core.sensor.options import read_preset as read_sensor_preset
from data_contracts.errors import DataError
from flows.command_line import apply_override, read_preset


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"seed: 1\nname: a\nseed: 2\n", "'seed' is there twice(.|\n)*line 3"),
        (b"sampling: {palette: grey, palette: rgb}\n", "'palette' is there twice"),
        (b"name: [a\n", "not a preset in YAML"),
        (b"name: \xff\n", "not a preset in YAML"),
        (b"- name\n", "a mapping of options, got list"),
    ],
)
def test_a_broken_preset_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    with pytest.raises(PluginError, match=message) as error:
        read_preset(tmp_path, str(path))
    assert "mine.yaml" in str(error.value)


def test_so_are_a_sensor_preset_and_an_override(tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text("leak_rate_hz: 1\nleak_rate_hz: 2\n")
    with pytest.raises(DataError, match="'leak_rate_hz' is there twice"):
        read_sensor_preset(path)
    with pytest.raises(PluginError, match="'palette' is there twice"):
        apply_override({}, "sampling={palette: grey, palette: rgb}")


def test_a_merged_mapping_may_be_overridden(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "a: &a {steps: 1, rate: 2}\nb: &b {<<: *a, steps: 3}\nc: {<<: *b, rate: 4}\nd: {<<: [*a, *b], x: 5}\n"
    )
    values = read_preset(tmp_path, str(path))
    assert values["b"] == {"steps": 3, "rate": 2}
    assert values["c"] == {"steps": 3, "rate": 4}
    assert values["d"] == {"steps": 1, "rate": 2, "x": 5}
