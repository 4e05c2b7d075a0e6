"""What a downstream model is trained on, and what a score is of: types for the names that tables hold.

A training set is written `recorded+synthetic@0.25`: sources joined by +, each with the share of its frames where that
is not all of them. A row of scores that is of no training set is of the labels of generated frames: `label agreement of
NAME`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

RECORDED, SYNTHETIC, ORACLE, LABEL_CONSISTENT = "recorded", "synthetic", "oracle", "label_consistent"
SOURCES = (RECORDED, SYNTHETIC, ORACLE, LABEL_CONSISTENT)
"""Sources that are not a baseline's name."""
HELD_OUT = "held-out recorded"
"""Subject of scores of the recorded frames that nothing was learnt from: the floor of those of generated frames."""

_SOURCE = re.compile(r"([A-Za-z0-9_-]+)(?:@([0-9.]+(?:e-?\d+)?))?")
_AGREEMENT = re.compile(r"(shuffled )?label agreement of (.+)")


@dataclass(frozen=True)
class TrainingSource:
    """Frames of one origin.

    Attributes:
        name: one of `SOURCES`, or the name of a baseline.
        share: of its frames, the first of them; 1 = all.
    """

    name: str
    share: float = 1.0

    def __str__(self) -> str:
        """`synthetic`, or `synthetic@0.25`."""
        return self.name if self.share == 1 else f"{self.name}@{self.share:g}"


@dataclass(frozen=True)
class TrainingSet:
    """The frames that a downstream model is trained on, of one or more sources."""

    sources: tuple[TrainingSource, ...]

    @classmethod
    def of(cls, *names: str) -> TrainingSet:
        """All frames of the named sources."""
        return cls(tuple(TrainingSource(name) for name in names))

    @classmethod
    def parse(cls, text: str) -> TrainingSet:
        """The training set that is written so.

        Raises:
            ValueError: it is not written as a training set is.
        """
        sources = []
        for part in text.split("+"):
            found = _SOURCE.fullmatch(part)
            if found is None:
                raise ValueError(f"expected sources joined by +, such as recorded+synthetic@0.25, got {text!r}")
            sources.append(TrainingSource(found[1], float(found[2] or 1)))
        return cls(tuple(sources))

    def __str__(self) -> str:
        """As `parse` reads it."""
        return "+".join(str(source) for source in self.sources)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the sources, without shares."""
        return tuple(source.name for source in self.sources)

    @property
    def in_part(self) -> bool:
        """Is there a source of which not all frames are used?"""
        return any(source.share != 1 for source in self.sources)

    @property
    def whole(self) -> TrainingSet:
        """The same sources, with all of their frames."""
        return TrainingSet.of(*self.names)

    def with_generator(self, name: str) -> TrainingSet:
        """The same with frames of another generator in the place of the experiment's own."""
        sources = (replace(source, name=name) if source.name == SYNTHETIC else source for source in self.sources)
        return TrainingSet(tuple(sources))


def with_recorded(name: str) -> str:
    """The training set of all recorded frames and all of another source, as it is written."""
    return str(TrainingSet.of(RECORDED, name))


@dataclass(frozen=True)
class LabelAgreement:
    """The subject of scores of a model trained on recorded frames, on generated frames with the labels they were made
    from.

    Attributes:
        generator: whose frames.
        shuffled: scored against the labels of other frames: how bad no agreement at all is.
    """

    generator: str
    shuffled: bool = False

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"{'shuffled ' if self.shuffled else ''}label agreement of {self.generator}"

    @classmethod
    def parse(cls, text: str) -> LabelAgreement | None:
        """The subject that is written so; None where a score is of something else."""
        found = _AGREEMENT.fullmatch(text)
        return None if found is None else cls(found[2], found[1] is not None)
