"""YAML that people write: read safely, refused where it says something twice, and bounded.

PyYAML's safe loader runs nothing, but a few lines of aliases of aliases stand for billions of values, and deep nesting
or long numbers end in errors of Python's own.
"""

from __future__ import annotations

from typing import Any

import yaml

MAX_LENGTH = 2**20
MAX_DEPTH = 50
MAX_VALUES = 100_000
"""With every alias counted as what it stands for. The largest preset has a few thousand."""
MAX_NUMBER_LENGTH = 40


class _BoundedLoader(yaml.SafeLoader):
    """YAML's safe loader with limits; alone it would also keep the last of two equal keys and say nothing."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node, unless it lies too deep or stands for too much."""
        event: Any = self.peek_event()
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(
                problem=f"nested more than {MAX_DEPTH} levels deep", problem_mark=event.start_mark
            )
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(event, yaml.AliasEvent) and id(node) not in self._sizes:
            raise yaml.MarkedYAMLError(problem="an alias within what it stands for", problem_mark=event.start_mark)
        if id(node) not in self._sizes:
            self._sizes[id(node)] = 1 + sum(self._sizes[id(part)] for part in _parts(node))
        if self._sizes[id(node)] > MAX_VALUES:
            raise yaml.MarkedYAMLError(
                problem=f"more than {MAX_VALUES} values, counting what aliases stand for", problem_mark=event.start_mark
            )
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """A mapping whose keys are plain and differ."""
        # Here and not when values are made: by then merged mappings (`<<`) have put their keys among the others.
        node = super().compose_mapping_node(anchor)
        names = set[str]()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(problem="a key is a list or mapping", problem_mark=key.start_mark)
            if key.value in names:
                raise yaml.MarkedYAMLError(problem=f"{key.value[:100]!r} is there twice", problem_mark=key.start_mark)
            names.add(str(key.value))
        return node

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """A value; one that Python cannot hold (a date that is none, a long number) is refused with its place."""
        if node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float") and len(node.value) > MAX_NUMBER_LENGTH:
            raise yaml.MarkedYAMLError(
                problem=f"a number of more than {MAX_NUMBER_LENGTH} characters", problem_mark=node.start_mark
            )
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError, TypeError) as error:
            raise yaml.MarkedYAMLError(problem=str(error)[:100], problem_mark=node.start_mark) from error


def _parts(node: Any) -> list[Any]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []


def load_yaml(text: str) -> Any:
    """The one document of a text.

    Raises:
        yaml.YAMLError: not YAML, a mapping with a key twice, or beyond a limit of this module; with line and column.
    """
    if len(text) > MAX_LENGTH:
        raise yaml.YAMLError(f"{len(text)} characters, at most {MAX_LENGTH} are read")
    return yaml.load(text, _BoundedLoader)
