"""What the report says about frames the quality filter rejected."""

import numpy as np
import pyarrow as pa

from ctlev_core.report.page.html import Table
from ctlev_core.report.sections.rejections import Rejections, count_rejections, rejection_sections
from data_contracts import tables
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, label_columns, read_manifest, write_manifest


def write_generated(folder, num_attempts, refused) -> Manifest:
    folder.mkdir()
    count = len(refused)
    names = [f"synthetic/{row:06d}" for row in range(count)]
    texts = ("subject", "class_name", "prompt", "generator", "checkpoint_digest", "scheduler")
    table = pa.table(
        {
            **{name: names for name in ("sample_id", "recording_id", "condition_id", "source_id")},
            **{name: [""] * count for name in texts},
            "split": ["train"] * count,
            "num_inference_steps": pa.array([1] * count, pa.int32()),
            "guidance_scale": [1.0] * count,
            "seed": list(range(count)),
            "num_attempts": pa.array(num_attempts, pa.int32()),
            "rejected": refused,
            **label_columns(Labels(("",) * count, np.arange(count))),
        }
    )
    ref = write_manifest(folder, table.select(tables.SYNTHETIC.arrow().names), tables.SYNTHETIC)
    return read_manifest(ref)


def test_refusals_are_counted_by_cause(tmp_path):
    causes = ["", "too dark: brightness 0", "empty: active_share 0", "", "too dark: brightness 0.1"]
    mixed = write_generated(tmp_path / "mixed", [1, 3, 3, 2, 3], causes)
    counts = count_rejections(mixed)
    assert counts == Rejections(5, 4, 3, {"too dark": 2, "empty": 1})
    assert str(counts) == "5 frames, 4 sampled again, 3 rejected to the last (too dark 2, empty 1)"
    clean = write_generated(tmp_path / "clean", [1, 1], ["", ""])
    (table,) = rejection_sections({"synthetic": mixed, "other": clean})
    assert isinstance(table, Table)
    assert [list(row) for row in table.rows] == [
        ["synthetic", 5, 4, 3, "too dark, empty"],
        ["other", 2, 0, 0, None],
    ]


def test_nothing_is_said_where_everything_passed_at_once(tmp_path):
    clean = write_generated(tmp_path / "clean", [1, 1], ["", ""])
    assert rejection_sections({"synthetic": clean}) == []
    assert str(count_rejections(clean)) == "2 frames, 0 sampled again, 0 rejected to the last"
