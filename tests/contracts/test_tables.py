"""A broken table is refused with the table, the column and the row in the message."""

import numpy as np
import pyarrow as pa
import pytest

from data_contracts import tables
from data_contracts.errors import DataError
from data_contracts.tables import check_table


def good_scores(**changed):
    columns = {
        "task": pa.array(["pose2d", "pose2d"]),
        "subject": pa.array(["recorded", "synthetic"]),
        "seed": pa.array([0, 0], pa.int64()),
        "group": pa.array(["all", "all"]),
        "metric": pa.array(["mpjpe2d_px", "mpjpe2d_px"]),
        "value": pa.array([6.5, 7.25], pa.float64()),
        "low": pa.array([6.0, None], pa.float64()),
        "high": pa.array([7.0, None], pa.float64()),
        "num_samples": pa.array([10, 10], pa.int64()),
        "num_train": pa.array([5, 0], pa.int64()),
        "model_digest": pa.array(["a", "b"]),
        "data_digest": pa.array(["c", "c"]),
    }
    return pa.table({**columns, **changed})


def test_good_table_is_returned_in_schema_order():
    table = good_scores()
    shuffled = table.select(table.column_names[::-1])
    checked = check_table(shuffled, tables.SCORES, "test")
    assert checked.column_names == [column.name for column in tables.SCORES.columns]
    assert checked["value"].to_pylist() == [6.5, 7.25]


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"value": pa.array([1.0, np.nan])}, r"'scores', column 'value', row 1: expected a finite number, got nan"),
        ({"value": pa.array([1, 2], pa.int64())}, r"column 'value': expected type double, got int64"),
        ({"num_samples": pa.array([1, 0], pa.int64())}, r"column 'num_samples', row 1: expected at least 1, got 0"),
        ({"task": pa.array([None, "x"])}, r"column 'task', row 0: expected a value, got None"),
    ],
)
def test_bad_value_is_named(changed, expected):
    with pytest.raises(DataError, match=expected):
        check_table(good_scores(**changed), tables.SCORES, "test")


def test_missing_and_unknown_columns_are_named():
    table = good_scores().drop_columns(["low"]).append_column("lower", pa.array([1.0, 2.0]))
    with pytest.raises(DataError, match=r"missing columns \['low'\], unknown columns \['lower'\]"):
        check_table(table, tables.SCORES, "test")


def test_key_must_be_unique_and_split_known():
    table = pa.table(
        {
            "recording_id": ["a", "b", "a"],
            "subject": ["s"] * 3,
            "class_name": ["c"] * 3,
            "splits": ["train"] * 3,
            **{
                name: pa.array([1, 1, 1], pa.int32() if name.startswith("sensor") else pa.int64())
                for name in (
                    "sensor_width_px", "sensor_height_px", "num_events", "num_positive", "num_negative",
                    "t_first_us", "t_last_us", "duration_us", "num_windows",
                )
            },
            **dict.fromkeys(("events_file", "event_images_file", "intensity_file"), ["x"] * 3),
            "events_batch": pa.nulls(3, pa.int32()),
        }
    )  # fmt: skip
    with pytest.raises(DataError, match=r"column 'recording_id', row 2: 'a' occurs twice"):
        check_table(table, tables.RECORDINGS, "test")
    parts = pa.table(
        {
            "recording_id": ["a"],
            "split": ["tset"],
            "event_start": pa.array([0], pa.int64()),
            "event_stop": pa.array([1], pa.int64()),
        }
    )
    with pytest.raises(DataError, match=r"column 'split', row 0: expected one of train, .*got 'tset'"):
        check_table(parts, tables.PARTS, "test")


@pytest.mark.parametrize("schema", tables.TABLES.values(), ids=tables.TABLES.keys())
def test_every_schema_is_documented_and_accepts_no_rows(schema):
    assert all(column.doc for column in schema.columns)
    assert len({column.name for column in schema.columns}) == len(schema.columns)
    assert check_table(schema.arrow().empty_table(), schema, "test").num_rows == 0


def test_numbers_inside_lists_must_be_finite_where_the_schema_says_so():
    nan = float("nan")
    labels = {"joints2d_px": [[1.0, nan]] * 2, "joints3d_mm": [None] * 2, "visible": [[True]] * 2}
    table = pa.table(
        {
            "recording_id": ["a", "b"],
            "subject": ["s"] * 2,
            "class_name": [""] * 2,
            "t_us": pa.array([0, 1], pa.int64()),
            "joint_set": ["dhp19"] * 2,
            "joints2d_px": pa.array(labels["joints2d_px"], pa.list_(pa.float32())),
            "visible": pa.array(labels["visible"], pa.list_(pa.bool_())),
            "joints3d_mm": pa.nulls(2, pa.list_(pa.float32())),
            "smpl_pose_rad": pa.array([[0.0, 1.0], [2.0, nan]], pa.list_(pa.float32())),
            "smpl_betas": pa.nulls(2, pa.list_(pa.float32())),
            "smpl_transl_m": pa.nulls(2, pa.list_(pa.float32())),
            "intrinsics_px": pa.nulls(2, pa.list_(pa.float32())),
        }
    )
    with pytest.raises(DataError, match=r"column 'smpl_pose_rad', row 1: expected finite numbers, got nan"):
        check_table(table, tables.LABELS, "test")
