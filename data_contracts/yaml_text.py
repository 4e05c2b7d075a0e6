"""YAML that people write: read safely, and refused where it says something twice."""

from __future__ import annotations

from typing import Any

import yaml


class _UniqueKeysLoader(yaml.SafeLoader):
    """YAML's safe loader, which alone would keep the last of two equal keys and say nothing."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        # Here and not when values are made: by then merged mappings (`<<`) have put their keys among the others.
        node = super().compose_mapping_node(anchor)
        names = set[str]()
        for key, _ in node.value:
            if key.value in names:
                raise yaml.MarkedYAMLError(problem=f"{key.value!r} is there twice", problem_mark=key.start_mark)
            names.add(str(key.value))
        return node


def load_yaml(text: str) -> Any:
    """The one document of a text.

    Raises:
        yaml.YAMLError: not YAML, or a mapping with a key twice; with line and column.
    """
    return yaml.load(text, _UniqueKeysLoader)
