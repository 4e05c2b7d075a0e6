"""The Arrow schemas of every manifest, with versions, units and allowed ranges.

A stage writes exactly one of these as its manifest; `check_table` holds on every write and every read.
"""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

from data_contracts.errors import DataError
from data_contracts.labels import SPLITS


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        name: column name; a unit is its suffix (`_us`, `_px`, `_mm`, `_rad`).
        type: Arrow type.
        doc: what it holds.
        minimum: smallest allowed value (also of list elements), inclusive.
        maximum: largest allowed value, inclusive.
        choices: the allowed values, or None for any.
        nullable: may values be missing?
        finite: must floating-point values be finite?
    """

    name: str
    type: pa.DataType
    doc: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] | None = None
    nullable: bool = False
    finite: bool = True


@dataclass(frozen=True)
class TableSchema:
    """A named, versioned table. `key` is the column whose values are unique, or None."""

    name: str
    version: int
    key: str | None
    columns: tuple[Column, ...]

    def arrow(self) -> pa.Schema:
        """The Arrow schema, with the documentation as field metadata."""
        fields = [pa.field(c.name, c.type, nullable=c.nullable, metadata={"doc": c.doc}) for c in self.columns]
        return pa.schema(fields)


_SPLIT = Column("split", pa.string(), "which part of the experiment the row belongs to", choices=SPLITS)
_RECORDING = Column("recording_id", pa.string(), "recording the row was made from")
_SUBJECT = Column("subject", pa.string(), "who or what was recorded")
_CLASS = Column("class_name", pa.string(), "class or motion; empty without classes")
_LABELS = (
    Column("joint_set", pa.string(), "joint order (ctlev_core.geometry.joint_sets); empty without joints"),
    Column("joints2d_px", pa.list_(pa.float32()), "J x (x, y), flattened; NaN = unknown", nullable=True, finite=False),
    Column("visible", pa.list_(pa.bool_()), "J flags", nullable=True),
    Column("joints3d_mm", pa.list_(pa.float32()), "J x (x, y, z), camera; NaN = unknown", nullable=True, finite=False),
    Column("smpl_pose_rad", pa.list_(pa.float32()), "24 x axis-angle, the root's first", nullable=True),
    Column("smpl_betas", pa.list_(pa.float32()), "10 shape coefficients", nullable=True),
    Column("smpl_transl_m", pa.list_(pa.float32()), "x, y, z, camera", nullable=True),
    Column("intrinsics_px", pa.list_(pa.float32()), "fx, fy, cx, cy of the image of joints2d_px", nullable=True),
)

RECORDINGS = TableSchema(
    "recordings",
    3,
    "recording_id",
    (
        _RECORDING,
        _SUBJECT,
        _CLASS,
        Column("splits", pa.string(), "the splits its parts belong to, joined by +"),
        Column("sensor_width_px", pa.int32(), "sensor width; 0 where labels are of no sensor", minimum=0),
        Column("sensor_height_px", pa.int32(), "sensor height; 0 where labels are of no sensor", minimum=0),
        Column("num_events", pa.int64(), "events in the whole recording", minimum=0),
        Column("num_positive", pa.int64(), "ON events", minimum=0),
        Column("num_negative", pa.int64(), "OFF events", minimum=0),
        Column("t_first_us", pa.int64(), "time stamp of the first event", minimum=0),
        Column("t_last_us", pa.int64(), "time stamp of the last event", minimum=0),
        Column("duration_us", pa.int64(), "t_last_us - t_first_us", minimum=0),
        Column(
            "num_windows", pa.int64(), "windows its authors cut; missing where that is left to the user", nullable=True
        ),
        Column("events_file", pa.string(), "file of the events; empty without events"),
        Column(
            "events_batch",
            pa.int32(),
            "its record batch in a file that recordings share; missing where it has its own",
            minimum=0,
            nullable=True,
        ),
        Column("event_images_file", pa.string(), "array of released event images; empty without"),
        Column("intensity_file", pa.string(), "array of grey pictures; empty without. Times lie beside: NAME.t_us.npy"),
    ),
)
PARTS = TableSchema(
    "parts",
    1,
    None,
    (
        _RECORDING,
        _SPLIT,
        Column("event_start", pa.int64(), "first event of the part", minimum=0),
        Column("event_stop", pa.int64(), "one past its last event", minimum=0),
    ),
)
WINDOWS = TableSchema(
    "windows",
    1,
    None,
    (
        _RECORDING,
        Column("event_start", pa.int64(), "first event of the window", minimum=0),
        Column("event_stop", pa.int64(), "one past its last event", minimum=0),
    ),
)
"""Windows as the dataset's authors cut them; `num_windows` of `recordings` tells which recordings have such."""
SYNONYMS = TableSchema(
    "synonyms",
    1,
    "class_name",
    (_CLASS, Column("names", pa.list_(pa.string()), "what the class may be called in a prompt")),
)
LABELS = TableSchema(
    "labels",
    3,
    None,
    (
        _RECORDING,
        _SUBJECT,
        _CLASS,
        Column("t_us", pa.int64(), "time of the label on the clock of the events"),
        *_LABELS,
    ),
)
WINDOW_LABELS = TableSchema("window_labels", 2, None, LABELS.columns)
"""One row for each row of `windows`, where the authors also say how a window is labelled; else no rows."""
FRAMES = TableSchema(
    "frames",
    4,
    "sample_id",
    (
        Column("sample_id", pa.string(), "the join key; row i of the array `frames` is row i of this table"),
        _RECORDING,
        _SUBJECT,
        _SPLIT,
        _CLASS,
        Column("t_start_us", pa.int64(), "first event of the window", minimum=0),
        Column("t_end_us", pa.int64(), "last event of the window", minimum=0),
        Column("t_us", pa.int64(), "the moment its labels are of: the middle of the window, or its end"),
        Column("num_events", pa.int64(), "events in the window", minimum=0),
        *_LABELS,
    ),
)
CONDITIONS = TableSchema(
    "conditions",
    4,
    "sample_id",
    (
        Column("sample_id", pa.string(), "the join key"),
        Column("source_id", pa.string(), "the frame or label moment the condition was rendered from"),
        _SUBJECT,
        _CLASS,
        Column("prompt", pa.string(), "text prompt"),
        Column("t_start_us", pa.int64(), "first event of the window, or where it would be", minimum=0),
        Column("t_end_us", pa.int64(), "last event of the window, or where it would be", minimum=0),
        *_LABELS,
    ),
)
LABEL_CHOICE = TableSchema(
    "label_choice",
    1,
    None,
    (
        Column("moment", pa.int64(), "row among the label moments of the split `condition`", minimum=0),
        _RECORDING,
        Column("t_us", pa.int64(), "its time", minimum=0),
        Column(
            "value",
            pa.float64(),
            "coverage: distance to the nearest pose that is recorded or chosen before, root mean square over joints, "
            "px; hard: the error to expect",
        ),
    ),
)
"""Labels to sample from, in the order in which they were chosen."""
TRAINING = TableSchema(
    "training",
    1,
    None,
    (
        Column("curve", pa.string(), "which loss", choices=("training", "validation", "shuffled")),
        Column("step", pa.int64(), "optimiser step", minimum=0),
        Column("loss", pa.float64(), "mean loss since the last logged step"),
    ),
)
LATENTS = TableSchema(
    "latents",
    1,
    None,
    (
        Column("sample_id", pa.string(), "the frame; rows of the files `mean_NNNN`, in order, are rows of this table"),
        Column("quarter_turns", pa.int32(), "turns against the clock before it was encoded", minimum=0, maximum=3),
    ),
)
SYNTHETIC = TableSchema(
    "synthetic",
    4,
    "sample_id",
    (
        Column("sample_id", pa.string(), "the join key; row i of the array `frames` is row i of this table"),
        Column("recording_id", pa.string(), "its own for every frame: no two share a scene or a sensor"),
        Column("condition_id", pa.string(), "sample_id of the condition it was made from"),
        Column("source_id", pa.string(), "the frame or label moment behind the condition"),
        _SUBJECT,
        _SPLIT,
        _CLASS,
        Column("prompt", pa.string(), "text prompt"),
        Column("generator", pa.string(), "generator plug-in and its VERSION"),
        Column("checkpoint_digest", pa.string(), "digest of the checkpoint's manifest"),
        Column("scheduler", pa.string(), "sampler"),
        Column("num_inference_steps", pa.int32(), "network evaluations per image", minimum=1),
        Column("guidance_scale", pa.float64(), "classifier-free guidance; 1 = none", minimum=0),
        Column("seed", pa.int64(), "seed of this row's last try, from which it can be made again alone", minimum=0),
        Column(
            "num_attempts", pa.int32(), "samplings of this row; the quality filter rejected all but the last", minimum=1
        ),
        Column("rejected", pa.string(), "why the quality filter rejected the last try; empty where it passed"),
        *_LABELS,
    ),
)
EVENT_STREAMS = TableSchema(
    "event_streams",
    1,
    "sample_id",
    (
        Column("sample_id", pa.string(), "the generated frame"),
        _CLASS,
        Column("file", pa.string(), "event file that holds the stream, relative to this table"),
        Column("t_start_us", pa.int64(), "where its window starts, on the clock of the file", minimum=0),
        Column("t_end_us", pa.int64(), "its last event, or the start where it has none", minimum=0),
        Column("event_start", pa.int64(), "its first event in the file", minimum=0),
        Column("num_events", pa.int64(), "its events", minimum=0),
        Column("has_polarity", pa.bool_(), "False: p is 1 throughout, because the image has no polarity"),
        Column("is_exact", pa.bool_(), "encoding the stream gives the generated image itself"),
        Column("error_levels", pa.float64(), "else mean difference over values that are not black", minimum=0),
        Column("seed", pa.int64(), "seed of this row alone", minimum=0),
        *_LABELS,
    ),
)
SCORES = TableSchema(
    "scores",
    1,
    None,
    (
        Column("task", pa.string(), "what was scored"),
        Column("subject", pa.string(), "what the model was trained on, or which images were compared"),
        Column("seed", pa.int64(), "seed of the downstream training", minimum=0),
        Column("group", pa.string(), "`all`, or the subset of the test data"),
        Column("metric", pa.string(), "score, with its unit"),
        Column("value", pa.float64(), "the score"),
        Column("low", pa.float64(), "lower end of the 95 % interval over recordings", nullable=True),
        Column("high", pa.float64(), "upper end of the 95 % interval over recordings", nullable=True),
        Column("num_samples", pa.int64(), "test samples", minimum=1),
        Column("num_train", pa.int64(), "training samples", minimum=0),
        Column("model_digest", pa.string(), "manifest digest of the model that was scored"),
        Column("data_digest", pa.string(), "manifest digest of the data it was scored on"),
    ),
)
SAMPLE_SCORES = TableSchema(
    "sample_scores",
    2,
    None,
    (
        Column("sample_id", pa.string(), "the join key"),
        _RECORDING,
        Column("metric", pa.string(), "the score whose mean over samples, by their weights, this is a part of"),
        Column("value", pa.float64(), "score of this sample alone; missing where it has none", nullable=True),
        Column("weight", pa.float64(), "of the sample in that mean: its visible joints, for example", minimum=0),
    ),
)
NEAREST_SEEN = TableSchema(
    "nearest_seen",
    1,
    None,
    (
        Column("unseen", pa.string(), "a class that was sampled, and that no training frame shows"),
        Column("rank", pa.int32(), "1 = the nearest", minimum=1),
        Column("seen", pa.string(), "a class that training frames show"),
        Column("similarity", pa.float64(), "cosine between the embeddings of the two names", minimum=-1, maximum=1),
    ),
)
REPORT = TableSchema(
    "report",
    1,
    None,
    (Column("table", pa.string(), "name of a table of the report"), Column("file", pa.string(), "its Parquet file")),
)
TIMED_SAMPLES = TableSchema(
    "timed_samples",
    1,
    None,
    (
        Column("condition_id", pa.string(), "sample_id of the condition; row i of the array `frames` is row i here"),
        Column("seed", pa.int64(), "seed of this row alone", minimum=0),
        Column("wall_seconds", pa.float64(), "time of its batch, networks loaded and warm, shared equally", minimum=0),
        Column("cpu_seconds", pa.float64(), "CPU time of its batch over all threads, shared equally", minimum=0),
        Column("unet_evaluations", pa.float64(), "forward passes of the U-Net an image, counted", minimum=1),
        Column("controlnet_evaluations", pa.float64(), "forward passes of the ControlNet an image", minimum=0),
    ),
)
SPEED_VS_ERROR = TableSchema(
    "speed_vs_error",
    1,
    None,
    (
        Column("study", pa.string(), "what was sampled from", choices=("generator", "exact_score", "precision")),
        Column("line", pa.string(), "which line of the plot: a solver with its settings, or what it is compared with"),
        Column("num_inference_steps", pa.int32(), "steps; 0 where nothing was sampled", minimum=0),
        Column("evaluations", pa.float64(), "evaluations of the U-Net an image; 0 where there were none", minimum=0),
        Column("metric", pa.string(), "what was measured, with its unit"),
        Column("against", pa.string(), "what it was compared with; empty for times and counts"),
        Column("value", pa.float64(), "the measurement"),
        Column("low", pa.float64(), "lower end of its 95 % interval", nullable=True),
        Column("high", pa.float64(), "upper end of its 95 % interval", nullable=True),
        Column("num_samples", pa.int64(), "images, or values, it was measured on", minimum=1),
    ),
)
CHAIN_FRAMES = TableSchema(
    "chain_frames",
    1,
    "sample_id",
    (
        Column("sample_id", pa.string(), "the recorded frame; row i of the array `frames` is row i of this table"),
        _RECORDING,
        Column("seed", pa.int64(), "seed of this row alone", minimum=0),
    ),
)
REALISM_CHAIN = TableSchema(
    "realism_chain",
    1,
    None,
    (
        Column(
            "link",
            pa.string(),
            "what recorded frames went through last",
            choices=("recorded", "autoencoder", "values", "counts", "denoised", "sampled"),
        ),
        Column("amount", pa.int32(), "time step of the noise, or steps of sampling; 0 = neither", minimum=0),
        Column("evaluations", pa.int32(), "of the network, an image", minimum=0),
        Column("metric", pa.string(), "`c2st`, or a number of `ctlev_core.realism.summary`, mean over recordings"),
        Column("value", pa.float64(), "of these frames; missing where it could not be measured", nullable=True),
        Column("low", pa.float64(), "lower end of its 95 % interval", nullable=True),
        Column("high", pa.float64(), "upper end", nullable=True),
        Column("difference", pa.float64(), "from the recorded frames, by recording; not of `c2st`", nullable=True),
        Column("difference_low", pa.float64(), "lower end of its 95 % interval", nullable=True),
        Column("difference_high", pa.float64(), "upper end", nullable=True),
        Column("num_samples", pa.int64(), "frames", minimum=0),
        Column("note", pa.string(), "why there is no value, or what it has to be read with"),
    ),
)
TWO_SAMPLE_TESTS = TableSchema(
    "two_sample_tests",
    1,
    None,
    (
        Column("group", pa.string(), "whose frames: as in the table of scores"),
        Column("subject", pa.string(), "`A against B`: which sets are told apart"),
        Column("value", pa.float64(), "area under the ROC curve, mean over trainings", nullable=True),
        Column("low", pa.float64(), "lower end of its 95 % interval", nullable=True),
        Column("high", pa.float64(), "upper end", nullable=True),
        Column("deviation", pa.float64(), "of the area over trainings", nullable=True),
        Column("num_first", pa.int64(), "frames of A", minimum=0),
        Column("num_second", pa.int64(), "frames of B", minimum=0),
        Column("note", pa.string(), "why there is no area, or what it has to be read with"),
    ),
)
_ALL = (
    RECORDINGS,
    PARTS,
    WINDOWS,
    SYNONYMS,
    LABELS,
    FRAMES,
    CONDITIONS,
    TRAINING,
    LATENTS,
    SYNTHETIC,
    EVENT_STREAMS,
    LABEL_CHOICE,
    SCORES,
    SAMPLE_SCORES,
    NEAREST_SEEN,
    REPORT,
    TIMED_SAMPLES,
    SPEED_VS_ERROR,
    CHAIN_FRAMES,
    REALISM_CHAIN,
    TWO_SAMPLE_TESTS,
)
TABLES = {schema.name: schema for schema in _ALL}


def check_table(table: pa.Table, schema: TableSchema, where: str) -> pa.Table:
    """Raise `DataError` naming table, column and row unless `table` keeps `schema`.

    Returns:
        The table, cast to the schema's exact column order and types without losing a value.
    """
    label = f"{where}: table {schema.name!r}"
    expected = [c.name for c in schema.columns]
    missing = [name for name in expected if name not in table.column_names]
    extra = [name for name in table.column_names if name not in expected]
    if missing or extra:
        raise DataError(f"{label}: missing columns {missing}, unknown columns {extra}; expected {expected}")
    columns = []
    for column in schema.columns:
        values = table[column.name].combine_chunks()
        if values.type != column.type:
            raise DataError(f"{label}, column {column.name!r}: expected type {column.type}, got {values.type}")
        _check_values(values, column, label)
        columns.append(values)
    if schema.key is not None:
        _check_unique(columns[expected.index(schema.key)], schema.key, label)
    return pa.table(columns, schema=schema.arrow())


def _check_values(values: pa.Array, column: Column, label: str) -> None:
    """Missing values, ranges, choices and finiteness of one column."""

    def refuse(wrong: pa.Array, expected: str) -> None:
        row = pc.index(wrong, True).as_py()
        if row >= 0:
            raise DataError(
                f"{label}, column {column.name!r}, row {row}: expected {expected}, got {values[row].as_py()!r}"
            )

    if not column.nullable and values.null_count:
        refuse(values.is_null(), "a value")
    if pa.types.is_list(column.type):
        _check_list_elements(values, column, label)
        return
    if pa.types.is_floating(column.type) and column.finite:
        refuse(pc.fill_null(pc.invert(pc.is_finite(values)), False), "a finite number")
    if column.minimum is not None:
        refuse(pc.fill_null(pc.less(values, column.minimum), False), f"at least {column.minimum:g}")
    if column.maximum is not None:
        refuse(pc.fill_null(pc.greater(values, column.maximum), False), f"at most {column.maximum:g}")
    if column.choices is not None:
        refuse(pc.invert(pc.is_in(values, value_set=pa.array(column.choices))), f"one of {', '.join(column.choices)}")


def _check_list_elements(values: pa.Array, column: Column, label: str) -> None:
    """Finiteness of the numbers inside the lists of one column."""
    elements = values.flatten()
    if not column.finite or not pa.types.is_floating(elements.type):
        return
    wrong = pc.index(pc.fill_null(pc.invert(pc.is_finite(elements)), False), True).as_py()
    if wrong >= 0:
        row = pc.list_parent_indices(values)[wrong].as_py()
        got = elements[wrong].as_py()
        raise DataError(f"{label}, column {column.name!r}, row {row}: expected finite numbers, got {got!r}")


def _check_unique(values: pa.Array, name: str, label: str) -> None:
    """The key column holds no value twice."""
    if len(pc.unique(values)) == len(values):
        return
    seen: set[str] = set()
    for row, value in enumerate(values.to_pylist()):
        if value in seen:
            raise DataError(f"{label}, column {name!r}, row {row}: {value!r} occurs twice")
        seen.add(value)
