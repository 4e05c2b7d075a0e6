"""Two objects in one picture and the words for it: `cat on box`, `boat with fish`.

The grammar is one rule, `<noun> <relation> <noun>`, so that whoever knows the nouns and the two relations can picture
compositions it has never seen. `on`: the first stands on top of the second. `with`: side by side on one ground, the
first on the left. Event cameras hardly see colour, so neither nouns nor relations need it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

from ctlev_core.studio.objects import OBJECTS

RELATIONS = ("on", "with")
"""Words that the tokenizer of the bundled base model has as a whole."""

NOUNS = tuple(noun for noun in OBJECTS if noun not in ("road", "spot", "street"))
"""All but those that are a ground or a place rather than a thing that stands somewhere."""


@dataclass(frozen=True)
class Composition:
    """Two different objects and where they are: `first` on the `relation` of `second`.

    Raises:
        ValueError: a word the grammar does not have, or the same noun twice.
    """

    first: str
    relation: str
    second: str

    def __post_init__(self) -> None:
        for noun in (self.first, self.second):
            if noun not in NOUNS:
                raise ValueError(f"composition: {noun!r} is no noun of the grammar, which has {', '.join(NOUNS)}")
        if self.relation not in RELATIONS:
            raise ValueError(f"composition: expected one of {', '.join(RELATIONS)}, got {self.relation!r}")
        if self.first == self.second:
            raise ValueError(f"composition: expected two different nouns, got {self.first!r} twice")

    @property
    def name(self) -> str:
        """Such as `cat on box`."""
        return f"{self.first} {self.relation} {self.second}"


def all_compositions() -> tuple[Composition, ...]:
    """Every sentence of the grammar, in a stable order."""
    return tuple(Composition(a, relation, b) for a, b in permutations(NOUNS, 2) for relation in RELATIONS)


def parse_composition(name: str) -> Composition:
    """The composition of a name such as `cat on box`.

    Raises:
        ValueError: the name is no sentence of the grammar.
    """
    words = name.split()
    if len(words) != 3:
        raise ValueError(f"composition: expected `<noun> <relation> <noun>` such as `cat on box`, got {name!r}")
    return Composition(*words)
