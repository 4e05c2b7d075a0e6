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


def row(training_set, metric, value, low=None, high=None, group="small pictures"):
    return {"subject": training_set, "group": group, "metric": metric, "value": value, "low": low, "high": high}


def test_generators_go_down_and_scores_across_with_the_closest_pairs_of_the_first():
    pair = {"subject": "synthetic", "features": "small pictures", "generated_row": 3, "training_row": 1}
    found = [
        manifest(
            [row("synthetic", "close_share", 0.02, 0.0, 0.05), row("synthetic", "duplicates", 1.0)],
            [
                {**pair, "distance": 0.5, "threshold": 2.0},
                {**pair, "training_row": 2, "distance": 0.0, "threshold": 0.0},
            ],
        ),
        manifest([row("gan", "close_share", 0.0, 0.0, 0.01), row("gan", "ratio", 1.5, group="features")]),
    ]
    table, grid = memorisation_sections(manifest([]), [manifest([])], found)
    assert isinstance(table, Table) and isinstance(grid, ImageGrid)
    assert table.columns == [
        "frames", "close copies, share: small pictures", "exact copies: small pictures", "ratio: features",
    ]  # fmt: skip
    assert table.rows == [["synthetic", "0.020 [0.000, 0.050]", "1", ""], ["GAN", "0.000 [0.000, 0.010]", "", "1.500"]]
    (_, generated), (_, training) = grid.rows
    np.testing.assert_array_equal(generated, FRAMES[[3, 3]])
    np.testing.assert_array_equal(training, FRAMES[[1, 2]])
    assert list(grid.column_labels) == ["0.25", "0"]


def test_nothing_compared_is_no_section():
    assert memorisation_sections(manifest([]), [], []) == []
