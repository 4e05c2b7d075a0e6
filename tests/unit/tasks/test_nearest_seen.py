"""The nearest seen classes, by text embeddings that are written down here."""

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from data_contracts import tables
from data_contracts.config import GeneratorChoice
from data_contracts.manifest import Manifest, ManifestRef
from tasks.nearest_seen import nearest_seen
from tasks.stage import Output

EMBEDDINGS = {"cat": (1, 0), "dog": (0.8, 0.6), "ferry": (0, 1), "kitten": (0.9, 0.1)}


def test_classes_of_training_frames_are_those_that_are_seen(tmp_path, monkeypatch):
    generator = SimpleNamespace(embed_names=lambda folder, names: np.array([EMBEDDINGS[name] for name in names]))
    monkeypatch.setattr(plugins, "load_options", lambda choice: SimpleNamespace(module=generator))
    ref = ManifestRef(key="some", path=tmp_path)
    rows = {"class_name": ["dog", "ferry", "cat", "kitten"] * 50, "split": (["train"] * 3 + ["test"]) * 50}
    frames = Manifest(ref, tables.FRAMES, pa.table(rows), {})
    conditions = Manifest(ref, tables.FRAMES, pa.table({"class_name": ["kitten", "cat"]}), {})
    column = Mock(wraps=frames.column)
    object.__setattr__(frames, "column", column)
    found = nearest_seen.function(
        Output(tmp_path, tmp_path), frames, frames, conditions, generator=GeneratorChoice(name="stable_diffusion")
    ).to_pylist()
    assert [(row["unseen"], row["rank"], row["seen"]) for row in found] == [
        ("kitten", 1, "cat"),
        ("kitten", 2, "dog"),
        ("kitten", 3, "ferry"),
    ]
    assert column.call_count == 2  # split and class once, however many frames there are
