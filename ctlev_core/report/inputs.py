"""What the report of an experiment is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from data_contracts.manifest import Manifest, ManifestRef

M = TypeVar("M", Manifest, ManifestRef)
"""Flows name artefacts by reference; the stage opens them."""


@dataclass(frozen=True, eq=False)
class Named(Generic[M]):
    """An artefact under the name that the report gives it."""

    name: str
    manifest: M


@dataclass(frozen=True, eq=False)
class GeneratedFrames(Generic[M]):
    """Frames of one generator.

    Attributes:
        name: of the generator; the experiment's own is `synthetic`.
        frames: that it made.
        memorisation: of the training frames by these.
        realism: these beside recorded frames.
    """

    name: str
    frames: M
    memorisation: M
    realism: M


@dataclass(frozen=True, eq=False)
class ReportInputs(Generic[M]):
    """All that a report shows.

    Attributes:
        title: of the page.
        notice: on the data, above everything else.
        training_sets: that models were trained on, in the order of the tables.
        recordings: as ingested.
        frames: recorded ones.
        frame_conditions: of the training frames.
        conditions: that were sampled from.
        generated: frames of each generator, the experiment's own first.
        checkpoints: generators that learnt.
        models: downstream models.
        scores: of models and of sets of frames.
        event_realism: events of the held-out recordings beside those of the training recordings.
        realism_floors: recorded frames told from one another.
        oracle: other recorded frames of the moments asked for.
        target: recorded frames of another dataset, which was tested on.
        nearest: what of the training set is most like the target's classes.
    """

    title: str
    notice: str
    training_sets: tuple[str, ...]
    recordings: M
    frames: M
    frame_conditions: M
    conditions: M
    generated: tuple[GeneratedFrames[M], ...]
    checkpoints: tuple[Named[M], ...]
    models: tuple[Named[M], ...]
    scores: tuple[M, ...]
    event_realism: M
    realism_floors: M
    oracle: M | None = None
    target: M | None = None
    nearest: M | None = None
