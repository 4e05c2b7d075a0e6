"""Several datasets as one: learnt from together, tested together and each apart.

    dataset:
      name: union
      options:
        joint_set: dhp19
        parts:
          dhp19: {name: dhp19, options: {root: FOLDER}}
          cdehp: {name: cdehp, options: {root: FOLDER}}

Recordings and people are called `part.dhp19/...`, so that nobody of one part is taken for somebody of another, and keep
their splits. Labels are those kinds that all parts have, joints in one order. With `windows.method: dataset` each part
is cut as its authors cut it. Beside scores over all test frames there are those of each part.

Source: Table 2 of ControlEvents trains on DHP19 and CDEHP together and tests on each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from ctlev_core import plugins
from ctlev_core.geometry.joint_sets import JOINT_SETS, joint_indices
from ctlev_core.plugin_contracts import (
    DatasetWithChunks,
    DatasetWithSynonyms,
    DatasetWithWindowLabels,
    DatasetWithWindows,
)
from ctlev_core.plugins import Plugin
from data_contracts.config import DatasetChoice, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import ImageTrack, Labels, Recording
from data_contracts.parts import PREFIX, is_part_name, part_of

VERSION = 1
_OF_JOINTS = ("joints2d", "visible", "joints3d")


class Options(Frozen):
    """Which datasets."""

    parts: dict[str, DatasetChoice] = Field(
        default_factory=dict, description="two or more datasets with their options, each under a name of its own"
    )
    joint_set: str = Field(
        default="",
        description="order of the joints: dhp19, cdehp, smpl; empty = as they come, where all parts have the same",
    )

    @field_validator("parts")
    @classmethod
    def _names_name_folders(cls, parts: dict[str, DatasetChoice]) -> dict[str, DatasetChoice]:
        for name, part in parts.items():
            if not is_part_name(name):
                raise ValueError(f"a part's name has letters, digits, '_' and '-' alone, got {name!r}")
            if part.name == "union":
                raise ValueError(f"part {name!r} is a union itself; name its parts here")
        return parts

    @field_validator("joint_set")
    @classmethod
    def _joint_set_is_known(cls, name: str) -> str:
        if name and name not in JOINT_SETS:
            raise ValueError(f"unknown joint set; known: {', '.join(JOINT_SETS)}")
        return name


def list_recordings(options: Options) -> list[Recording]:
    """Every recording of every part.

    Raises:
        DataError: fewer than two parts, a part cannot be listed, or its labels do not go with those of the others.
    """
    if len(options.parts) < 2:
        raise DataError(f"union: expected two or more datasets under parts, got {len(options.parts)}")
    found = []
    for name, part in options.parts.items():
        plugin = plugins.load_options(part)
        for recording in plugin.module.list_recordings(plugin.options):
            full = f"{PREFIX}{name}/{recording.recording_id}", f"{PREFIX}{name}/{recording.subject}"
            found.append(replace(recording, recording_id=full[0], subject=full[1]))
    _kinds(options.model_dump_json())
    return found


def read_events(recording: Recording, options: Options) -> Events:
    """As its dataset reads them."""
    plugin, own = _own(recording, options)
    return plugin.module.read_events(own, plugin.options)


def read_event_chunks(recording: Recording, options: Options) -> Iterator[Events]:
    """As its dataset reads them; as one chunk where that reads recordings as a whole."""
    plugin, own = _own(recording, options)
    if isinstance(plugin.module, DatasetWithChunks):
        yield from plugin.module.read_event_chunks(own, plugin.options)
    else:
        yield plugin.module.read_events(own, plugin.options)


def read_labels(recording: Recording, options: Options) -> Labels:
    """The kinds of labels that all parts have, joints in the common order."""
    plugin, own = _own(recording, options)
    return _as_agreed(plugin.module.read_labels(own, plugin.options), options)


def read_windows(recording: Recording, options: Options) -> np.ndarray | None:
    """The windows of its dataset's authors; None where they have none."""
    plugin, own = _own(recording, options)
    if not isinstance(plugin.module, DatasetWithWindows):
        return None
    return plugin.module.read_windows(own, plugin.options)


def read_window_labels(recording: Recording, options: Options) -> Labels | None:
    """The labels that its dataset's authors give to these; None where they have no rule of their own."""
    plugin, own = _own(recording, options)
    if not isinstance(plugin.module, DatasetWithWindowLabels):
        return None
    labels = plugin.module.read_window_labels(own, plugin.options)
    return None if labels is None else _as_agreed(labels, options)


def read_synonyms(options: Options) -> dict[str, list[str]]:
    """Further names of the classes of all parts."""
    found: dict[str, list[str]] = {}
    for part in options.parts.values():
        plugin = plugins.load_options(part)
        if isinstance(plugin.module, DatasetWithSynonyms):
            for name, names in plugin.module.read_synonyms(plugin.options).items():
                found[name] = list(dict.fromkeys([*found.get(name, []), *names]))
    return found


def read_event_images(recording: Recording, options: Options) -> ImageTrack:
    """As its dataset reads them."""
    plugin, own = _own(recording, options)
    return plugin.module.read_event_images(own, plugin.options)


def read_intensity_frames(recording: Recording, options: Options) -> ImageTrack:
    """As its dataset reads them."""
    plugin, own = _own(recording, options)
    return plugin.module.read_intensity_frames(own, plugin.options)


def _own(recording: Recording, options: Options) -> tuple[Plugin, Recording]:
    """The dataset of a recording, and the recording as that knows it."""
    name = part_of(recording.recording_id)
    prefix = f"{PREFIX}{name}/"
    own = replace(
        recording,
        recording_id=recording.recording_id.removeprefix(prefix),
        subject=recording.subject.removeprefix(prefix),
    )
    return plugins.load_options(options.parts[name]), own


def _as_agreed(labels: Labels, options: Options) -> Labels:
    shared, joint_set = _kinds(options.model_dump_json())
    labels = replace(labels, **{name: None for name in labels.arrays if name not in shared})
    if not labels.joint_set or labels.joint_set == joint_set:
        return labels
    order = joint_indices(labels.joint_set, joint_set)
    arrays: dict[str, Any] = {name: labels.arrays[name][:, order] for name in _OF_JOINTS if name in labels.arrays}
    return replace(labels, joint_set=joint_set, **arrays)


@lru_cache(maxsize=8)
def _kinds(options_json: str) -> tuple[frozenset[str], str]:
    """Kinds of labels that the first labelled recording of each part has, and the order of joints.

    Raises:
        DataError: the parts have no kind in common but classes, or joints in several orders, of which none is chosen.
    """
    options = Options.model_validate_json(options_json)
    first = {}
    for name, part in options.parts.items():
        plugin = plugins.load_options(part)
        first[name] = plugin.module.read_labels(plugin.module.list_recordings(plugin.options)[0], plugin.options)
    shared = frozenset.intersection(*(frozenset(labels.arrays) for labels in first.values()))
    sets = {name: labels.joint_set for name, labels in first.items() if labels.joint_set}
    told = ", ".join(f"{name}: {', '.join(labels.arrays) or 'classes alone'}" for name, labels in first.items())
    if not shared and any(labels.arrays for labels in first.values()):
        raise DataError(f"union: expected labels of one kind in all parts, got {told}")
    if not options.joint_set and len(set(sets.values())) > 1:
        raise DataError(f"union: joints come in several orders ({sets}); choose one by dataset.options.joint_set")
    for joint_set in set(sets.values()) if options.joint_set else ():
        joint_indices(joint_set, options.joint_set)
    return shared, options.joint_set or next(iter(sets.values()), "")
