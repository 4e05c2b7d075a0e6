"""What the report says about copies."""

from types import SimpleNamespace

import numpy as np
import pyarrow as pa

from ctlev_core.report.page.html import ImageGrid, Table
from ctlev_core.report.sections.memorisation import memorisation_sections

FRAMES = np.arange(4 * 8 * 8 * 3, dtype=np.uint8).reshape(4, 8, 8, 3)


def manifest(rows, pairs=()):
    return SimpleNamespace(
        table=pa.Table.from_pylist(rows),
        attached=lambda schema: pa.Table.from_pylist(list(pairs)),
        array=lambda _: FRAMES,
    )


def row(training_set, metric, value, low=None, high=None, group="small pictures", num_samples=300):
    return {
        "subject": training_set, "group": group, "metric": metric, "value": value, "low": low, "high": high,
        "num_samples": num_samples, "num_train": 600,
    }  # fmt: skip


def test_sets_and_features_go_down_and_scores_across_with_the_floor_last_and_once():
    pair = {"subject": "synthetic", "features": "small pictures", "generated_row": 3, "training_row": 1}
    floor = [row("held-out recorded", "close_share", 0.01, 0.0, 0.03, num_samples=90)]
    found = [
        manifest(
            [
                row("synthetic", "close_share", 0.02, 0.0, 0.05),
                row("synthetic", "duplicates", 1.0),
                row("synthetic", "data_copying_z", -4.0, -6.0, -2.0),
                row("synthetic", "authentic_share", 0.4, 0.35, 0.45, group="features"),
                *floor,
            ],
            [
                {**pair, "distance": 0.5, "threshold": 2.0},
                {**pair, "training_row": 2, "distance": 0.0, "threshold": 0.0},
            ],
        ),
        manifest([row("gan", "close_share", 0.0, 0.0, 0.01), *floor]),
    ]
    table, grid = memorisation_sections(manifest([]), [manifest([])], found)
    assert isinstance(table, Table) and isinstance(grid, ImageGrid)
    assert table.columns == [
        "frames", "compared in", "close copies, share", "exact copies", "data-copying test (C_T)",
        "authentic frames, share", "number", "training frames",
    ]  # fmt: skip
    assert table.rows == [
        ["synthetic", "small pictures", "0.020 [0.000, 0.050]", "1", "-4.000 [-6.000, -2.000]", "", 300, 600],
        ["synthetic", "features", "", "", "", "0.400 [0.350, 0.450]", 300, 600],
        ["GAN", "small pictures", "0.000 [0.000, 0.010]", "", "", "", 300, 600],
        ["held-out recorded", "small pictures", "0.010 [0.000, 0.030]", "", "", "", 90, 600],
    ]
    (_, generated), (_, training) = grid.rows
    np.testing.assert_array_equal(generated, FRAMES[[3, 3]])
    np.testing.assert_array_equal(training, FRAMES[[1, 2]])
    assert list(grid.column_labels) == ["0.25", "0"]


def test_nothing_compared_is_no_section():
    assert memorisation_sections(manifest([]), [], []) == []
