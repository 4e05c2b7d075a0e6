"""The README of an exported folder of images: what data it is, what its columns mean, how to read it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.provenance.records import Record, versions_of
from data_contracts.image_folder import IMAGES, is_empty
from data_contracts.manifest import LABEL_COLUMNS

MAX_CLASSES = 50
"""Classes that are listed one by one."""
_COLOURS = {
    True: "Black: no event. Red: positive events (brighter), blue: negative ones (darker).",
    False: "Black: no event. Grey to white: events, of either polarity.",
}


@dataclass(frozen=True)
class Card:
    """What a card tells.

    Attributes:
        name: of the experiment.
        notice: what data it was learnt from.
        table: the exported rows, columns of `data_contracts.image_folder.IMAGES`.
        image_size: (width, height) px.
        num_rejected: rows that were left out because the quality filter rejected them.
        event_suffix: of the files of event streams; empty without.
        records: provenance; the first is that of the frames.
    """

    name: str
    notice: str
    table: pa.Table
    image_size: tuple[int, int]
    num_rejected: int
    event_suffix: str
    records: Sequence[Record]


def render_card(card: Card) -> str:
    """The text, in Markdown."""
    return _front_matter(card) + _text(card)


def _front_matter(card: Card) -> str:
    """What the pages of a hub sort data sets by."""
    from huggingface_hub import DatasetCardData

    tasks = ["keypoint-detection"] if card.table["joint_set"][0].as_py() else ["image-classification"]
    data = DatasetCardData(
        pretty_name=card.name,
        license="other",
        task_categories=tasks,
        size_categories=_size(card.table.num_rows),
        tags=["event-camera", "synthetic", "ctlev"],
    )
    return f"---\n{data.to_yaml()}\n---\n\n"


def _size(num_rows: int) -> str:
    """The hub's names of sizes."""
    sizes = ("1K", "10K", "100K", "1M", "10M", "100M")
    for number, size in enumerate(sizes):
        if num_rows < 1_000 * 10**number:
            return f"{sizes[number - 1]}<n<{size}" if number else f"n<{size}"
    return "n>100M"


def _text(card: Card) -> str:
    parts = [_head(card), _files(card), _reading(card), _labels(card), _columns(card), _origin(card)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _head(card: Card) -> str:
    width, height = card.image_size
    lines = [f"# {card.name}: {card.table.num_rows:,} synthetic event images with labels"]
    if card.notice:
        lines.append(f"> {card.notice}")
    text = (
        f"Images of an event camera, {width} x {height} px, made by a generator that was trained on recordings, each "
        "from the label in its row. No camera took them. A label is what was asked for; an image may show it badly."
    )
    if card.num_rejected:
        text += f" {card.num_rejected:,} more images came out as no event images at all and were left out."
    return "\n\n".join([*lines, text])


def _files(card: Card) -> str:
    names = {
        "labels.parquet": "one row an image: file, label, how it was made; `metadata.parquet`: the same for `datasets`",
        "images/": "PNG, RGB, 8 bit, 1,000 a sub-folder. " + _encoding(card.records),
    }
    if _has(card.table, "condition_file_name"):
        names["conditions/"] = "the picture each image was asked for with, same names"
    if card.event_suffix:
        names["events/"] = (
            f"the images as event streams, `{card.event_suffix}`, times in microseconds. Counted again a stream gives "
            "its image; its times are drawn like those of the recordings, and directions of motion are made up"
        )
    names["provenance.json"] = "options, versions, seeds and digests of every stage behind this folder"
    return "## Files\n\n" + _rows("file", "what", names.items())


def _encoding(records: Sequence[Record]) -> str:
    """What the colours mean, where the encoding is one whose colours are known here."""
    encoding = next((record.arguments["encoding"] for record in records if record.stage == "encode"), {})
    options: dict[str, Any] = encoding.get("options", {})
    if encoding.get("plugin") != "encodings/event_histogram":
        return f"Encoding: {encoding['plugin'].partition('/')[2]}." if encoding else ""
    return _COLOURS[options["polarity"]] + " The brighter, the more events"


def _reading(card: Card) -> str:
    blocks = [
        ("pandas and OpenCV", _PANDAS),
        ("Hugging Face `datasets`, images decoded", _DATASETS),
        ("PyTorch, with the package `ctlev`", _TORCH),
    ]
    if card.event_suffix == ".parquet":
        blocks.append(("Events, as columns t, x, y, p", _EVENTS))
    texts = [f"{title}:\n\n```python\n{code}```" for title, code in blocks]
    return "\n\n".join(["## Reading it", "From within this folder.", *texts])


_PANDAS = """\
import cv2, pandas

labels = pandas.read_parquet("labels.parquet")
image = cv2.imread(labels["file_name"][0])  # [H, W, 3] uint8, blue first
"""
_DATASETS = """\
from datasets import load_dataset

rows = load_dataset("imagefolder", data_dir=".", split="train")  # the class by name, and as a ClassLabel, `label`
table = load_dataset("parquet", data_files="labels.parquet", split="train")  # names of files in the place of images
"""
_TORCH = """\
from torch.utils.data import DataLoader
from ctlev_core.export.event_dataset import EventDataset

for batch in DataLoader(EventDataset("."), batch_size=32, shuffle=True):
    batch["image"]  # [N, 3, H, W] float32, 0 to 1; labels under the names of the columns
"""
_EVENTS = """\
row = labels.iloc[0]
events = pandas.read_parquet(row["events_file"])[row["event_start"] :][: row["num_events"]]
"""


def _labels(card: Card) -> str:
    counts = Counter(card.table["class_name"].to_pylist())
    counts.pop("", None)
    parts = []
    if counts:
        common = [f"{_literal(name)} ({count:,})" for name, count in sorted(counts.items())[:MAX_CLASSES]]
        more = f" and {len(counts) - MAX_CLASSES} more" if len(counts) > MAX_CLASSES else ""
        parts.append(f"{len(counts):,} classes, in the column `class_name`: {', '.join(common)}{more}.")
    joint_set = card.table["joint_set"][0].as_py()
    if joint_set:
        joints = ", ".join(f"{number} {name}" for number, name in enumerate(JOINT_SETS[joint_set].joints))
        parts.append(f"Joints, order `{joint_set}`; left and right are the person's own: {joints}.")
    if any(_has(card.table, column) for column in LABEL_COLUMNS.values()):
        parts.append(
            "Image points: x right, y down, pixel centres at integer + 0.5. Camera frame: x right, y down, z forward. "
            "NaN means unknown; reshape lists of joints to J x 2 or J x 3."
        )
    return "\n\n".join(["## Labels", *parts]) if parts else ""


def _literal(text: str) -> str:
    """A name from elsewhere, with every sign escaped that Markdown or HTML would read."""
    return re.sub(r"([\\`*_\[\]<>|#~&])", r"\\\1", text)


def _columns(card: Card) -> str:
    kept = [column for column in IMAGES.columns if column.name in card.table.column_names]
    told = [(f"`{column.name}`", column.doc) for column in kept if _has(card.table, column.name)]
    return "## Columns of labels.parquet\n\n" + _rows("column", "what", told, code=False)


def _origin(card: Card) -> str:
    row = {name: card.table[name][0].as_py() for name in ("generator", "scheduler", "num_inference_steps")}
    versions = versions_of(card.records)
    told = {name: versions[name] for name in ("ctlev", "torch", "diffusers", "python") if name in versions}
    sampler = f", {row['num_inference_steps']} steps of {row['scheduler']}" if row["scheduler"] else ""
    stages = [(record.role, f"{record.stage}, key `{record.key}`, digest `{record.digest}`") for record in card.records]
    return "\n\n".join(
        [
            "## Where it comes from",
            f"Generator {row['generator']}{sampler}; each image from the seed in its row. "
            + ", ".join(f"{name} {version}" for name, version in told.items())
            + ". Licences of the recordings and weights it was learnt from hold for it too.",
            _rows("artefact", "stage", stages, code=False),
        ]
    )


def _has(table: pa.Table, name: str) -> bool:
    return name in table.column_names and not is_empty(table[name])


def _rows(first: str, second: str, rows: Any, *, code: bool = True) -> str:
    lines = [f"| {first} | {second} |", "|---|---|"]
    for name, text in rows:
        lines.append(f"| {f'`{name}`' if code else name} | {text.replace('|', chr(92) + '|')} |")
    return "\n".join(lines)
