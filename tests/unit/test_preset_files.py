"""Preset files that say something twice or are no YAML are refused, with the place; merged mappings are not."""

from pathlib import Path

import pytest

from ctlev_core.plugins import PluginError
from flows.command_line import read_preset


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


def test_a_merged_mapping_may_be_overridden(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "a: &a {steps: 1, rate: 2}\nb: &b {<<: *a, steps: 3}\nc: {<<: *b, rate: 4}\nd: {<<: [*a, *b], x: 5}\n"
    )
    values = read_preset(tmp_path, str(path))
    assert values["b"] == {"steps": 3, "rate": 2}
    assert values["c"] == {"steps": 3, "rate": 4}
    assert values["d"] == {"steps": 1, "rate": 2, "x": 5}
