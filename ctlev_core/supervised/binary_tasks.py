"""A task of several classes as one binary task of each: the class, or anything else.

The folder of such a model has one folder of each class, `000`, `001` .., and `binary.json` with their names.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from ctlev_core.labels.label_sampling import spread_choice
from ctlev_core.seeds import sample_seeds
from data_contracts.image_rows import Images, as_image_rows
from data_contracts.labels import History, Labels

Negatives = Literal["balanced", "all"]
BINARY_FILE = "binary.json"


def binary_rows(
    class_names: Sequence[str],
    name: str,
    negatives: Negatives,
    *,
    seed: int,
    parts: Sequence[int] = (),
    groups: Sequence[str] = (),
) -> tuple[np.ndarray, list[int]]:
    """The rows that a classifier of one class against the others learns from.

    Args:
        class_names: N classes.
        name: the class that is told from the others.
        negatives: `all` frames of other classes; or `balanced`, of each training set as many as it has of the class,
            as far as there are so many, drawn evenly from the other classes and from their groups.
        seed: of the draw.
        parts: rows of each training set, in order; empty = one set.
        groups: N subjects or recordings; empty = each row is its own.
    Returns:
        Rows [M] int64, ascending, and how many of them are of each training set.
    """
    names = np.array(class_names)
    owners = np.array(groups) if len(groups) else np.arange(len(names)).astype(str)
    chosen: list[np.ndarray] = []
    sizes = list(parts) or [len(names)]
    sets = np.split(np.arange(len(names)), np.cumsum(sizes)[:-1])
    for rows, own_seed in zip(sets, sample_seeds(seed, len(sizes)), strict=True):
        positive, other = rows[names[rows] == name], rows[names[rows] != name]
        if negatives == "balanced" and len(other) > len(positive):
            other = other[spread_choice(names[other].tolist(), owners[other].tolist(), len(positive), own_seed)]
        chosen.append(np.sort(np.concatenate([positive, other])))
    return np.concatenate(chosen), [len(rows) for rows in chosen]


def train_each(
    train: Callable[..., History],
    frames: Images,
    labels: Labels,
    classes: Sequence[str],
    negatives: Negatives,
    *,
    seed: int,
    out: Path,
    work: Path,
    parts: Sequence[int],
    groups: Sequence[str],
) -> History:
    """Train a classifier of each class against the others.

    Args:
        train: takes frames, labels with two class names, `out`, `work`, `parts` and `groups`.
        frames: [N, H, W, 3] uint8.
        labels: N rows with class names.
        classes: their names.
        negatives: as `binary_rows`.
        seed: of the draw of negatives.
        out: folder of the models.
        work: folder of the resumable state of each.
        parts: rows of each training set.
        groups: N subjects or recordings, or empty.
    Returns:
        The histories, one after another.
    """
    history = History()
    images, seeds = as_image_rows(frames), sample_seeds(seed, len(classes))
    for number, (name, own_seed) in enumerate(zip(classes, seeds, strict=True)):
        rows, sizes = binary_rows(labels.class_names, name, negatives, seed=own_seed, parts=parts, groups=groups)
        own = labels.take(rows)
        two = tuple(name if one == name else f"not {name}" for one in own.class_names)
        found = train(
            images.take(rows),
            replace(own, class_names=two),
            out=_folder(out, number),
            work=_folder(work, number),
            parts=sizes,
            groups=[groups[row] for row in rows] if len(groups) else (),
        )
        _append(history, found)
    (out / BINARY_FILE).write_text(json.dumps({"classes": list(classes)}, indent=2) + "\n", encoding="utf-8")
    return history


def is_binary(model: Path) -> bool:
    """Is it the folder of a model that `train_each` made?"""
    return (model / BINARY_FILE).is_file()


def predict_each(predict: Callable[[Path], Mapping[str, np.ndarray]], model: Path) -> Mapping[str, np.ndarray]:
    """What the classifiers of a folder say.

    Args:
        predict: gives `probability` [N, 2] and `classes` [2] of the model in a folder.
        model: folder written by `train_each`.
    Returns:
        `binary_probability` [N, K] float32, of each class by its own classifier; `probability` [N, K], the same scaled
        to a sum of 1 in each row, to name one class of all; and `classes` [K].
    """
    classes = json.loads((model / BINARY_FILE).read_text(encoding="utf-8"))["classes"]
    columns = []
    for number, name in enumerate(classes):
        found = predict(_folder(model, number))
        columns.append(found["probability"][:, found["classes"].tolist().index(name)])
    binary = np.stack(columns, axis=1).astype(np.float32)
    total = binary.sum(axis=1, keepdims=True)
    shared = np.where(total > 0, binary / np.where(total > 0, total, 1.0), 1 / len(classes)).astype(np.float32)
    return {"probability": shared, "binary_probability": binary, "classes": np.array(classes)}


def _folder(parent: Path, number: int) -> Path:
    return parent / f"{number:03d}"


def _append(history: History, more: History) -> None:
    """Add a history behind the last step of another."""
    before = max([0, *history.step, *history.validation_step])
    history.step += [before + step for step in more.step]
    history.validation_step += [before + step for step in more.validation_step]
    for name in ("loss", "validation_loss", "shuffled_loss"):
        getattr(history, name).extend(getattr(more, name))
