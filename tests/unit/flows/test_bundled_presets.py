"""Bundled presets can be read by somebody who knows little YAML."""

import pytest
import yaml

from flows.preset_list import PRESETS

PATHS = sorted(PRESETS.rglob("*.yaml"))


@pytest.mark.parametrize("path", PATHS, ids=[str(path.relative_to(PRESETS)) for path in PATHS])
def test_a_preset_has_no_anchors_and_says_first_what_it_is(path):
    text = path.read_text(encoding="utf-8")
    assert not [token for token in yaml.scan(text) if isinstance(token, yaml.AnchorToken | yaml.AliasToken)]
    assert text.startswith("# Summary: ")
