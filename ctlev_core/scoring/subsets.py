"""Which rows of a test set are scored together: all, each class, classes by origin, and subjects by whether a model
could have learnt from them.

A group is a name and the numbers of its rows. Whatever a model was trained on, the same rows are in a group: what it
had to learn from is that of the whole experiment, so that training sets compare.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from data_contracts.parts import part_of

Group = tuple[str, np.ndarray]
DATASET = "dataset "
"""Groups that begin so are the rows of one dataset of a union."""
MAX_SINGLE_SUBJECTS = 10
"""Up to so many subjects each have scores of their own."""


def class_groups(class_names: Sequence[str]) -> list[Group]:
    """All rows, and those of each class; one that is called `all` itself is `class all`."""
    names = np.array(class_names)
    classes = [name for name in dict.fromkeys(class_names) if name]
    of_class = [(f"class {name}" if name == "all" else name, np.flatnonzero(names == name)) for name in sorted(classes)]
    return [("all", np.arange(len(names))), *of_class]


def origin_groups(class_names: Sequence[str], real: Collection[str], sampled: Collection[str]) -> list[Group]:
    """Rows by where their class was to be learnt from; nothing where one group has them all.

    Args:
        class_names: [N].
        real: classes of the recorded training frames.
        sampled: classes that synthetic frames were asked for.
    """
    seen = set(real)
    parts = {
        "classes with recorded training frames": seen,
        "classes with synthetic frames only": set(sampled) - seen,
        "classes without training frames": set(class_names) - seen - set(sampled),
    }
    return _divide(parts, class_names)


def subject_groups(subjects: Sequence[str], recordings: Sequence[str], learnt: Collection[str]) -> list[Group]:
    """Rows by whether their subject was to be learnt from, and those of each subject.

    The first two where both occur: recordings split in time share their subject between training and test. The others
    where there are two to ten subjects, and more recordings than subjects: a subject that is another word for a
    recording says nothing new, and with few subjects an interval over recordings hides how much they differ.

    Args:
        subjects: [N].
        recordings: [N].
        learnt: subjects of the recorded training frames, and of the poses that synthetic frames were asked for.
    """
    present = sorted(set(subjects))
    parts = {
        "subjects learnt from": set(present) & set(learnt),
        "subjects not learnt from": set(present) - set(learnt),
    }
    groups = _divide(parts, subjects)
    if 2 <= len(present) <= MAX_SINGLE_SUBJECTS and len(present) < len(set(recordings)):
        groups += _divide({f"subject {name}": {name} for name in present}, subjects)
    return groups


def part_groups(recordings: Sequence[str]) -> list[Group]:
    """Rows of each dataset of a union, by the names [N] of their recordings; none where there is one dataset."""
    names = [part_of(recording) for recording in recordings]
    return _divide({f"{DATASET}{name}": {name} for name in dict.fromkeys(names)}, names)


def _divide(parts: dict[str, set[str]], names: Sequence[str]) -> list[Group]:
    """The rows of each part, but for empty ones and one that has them all."""
    groups = [(part, np.flatnonzero([name in members for name in names])) for part, members in parts.items()]
    return [(part, rows) for part, rows in groups if 0 < len(rows) < len(names)]
