"""Errors in px of the sensor against closed forms: of a known shift, whatever the fit, the sensor and the mixture."""

from unittest.mock import Mock

import numpy as np
import pyarrow as pa
import pytest

from ctlev_core import plugins
from ctlev_core.downstream import pose2d
from ctlev_core.labels.sources import sensor_size_of
from ctlev_core.plugins import PluginError
from ctlev_core.scoring import sensor_pixels
from ctlev_core.scoring.sensor_pixels import SensorSource, check_in_image, on_sensor, sensor_sizes
from data_contracts import tables
from data_contracts.config import DownstreamChoice, EncodingChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, ManifestRef, label_columns, read_manifest, write_manifest
from flows.command_line import PRESETS, load_preset
from flows.evaluate import evaluate
from tasks.evaluate import score_model
from tasks.stage import Output, call_flow, planning

SHIFT = np.array([3.0, 4.0])
"""Sensor px by which every prediction is wrong: an error of 5."""
DAVIS, CELEX, TALL = (346, 260), (1280, 800), (100, 400)
METRICS = [MetricChoice(name="mpjpe2d"), MetricChoice(name="mpjpe2d_sensor")]


def encoding(fit="pad", image_size=(64, 64)):
    return EncodingChoice(name="event_histogram", options={"image_size": image_size, "fit": fit})


def in_image(points, size, choice):
    plugin = plugins.load_options(choice)
    return plugin.module.map_points(points, size, plugin.options)


def joints_of(sizes, seed=0):
    """[N, 13, 2] sensor px in the middle of each sensor, where no crop cuts them off."""
    middle, spread = np.array(sizes)[:, None] / 2, min(min(size) for size in sizes) / 4
    return middle + np.random.default_rng(seed).uniform(-spread, spread, (len(sizes), 13, 2))


def labelled(sizes, choice):
    true = joints_of(sizes)
    labels, found = (
        np.stack([in_image(points + by, size, choice) for points, size in zip(true, sizes, strict=True)])
        for by in (0.0, SHIFT)
    )
    names = ("",) * len(sizes)
    visible = np.ones((len(sizes), 13), bool)
    return Labels(names, np.zeros(len(sizes), np.int64), labels.astype(np.float32), visible, "dhp19"), found


@pytest.mark.parametrize("fit", ["pad", "crop", "stretch", "centre"])
@pytest.mark.parametrize("size", [DAVIS, CELEX, TALL])
def test_a_known_shift_on_the_sensor_is_found_in_any_image(fit, size):
    choice = encoding(fit, (64, 48))
    labels, found = labelled([size] * 4, choice)
    moved, true = on_sensor({"joints2d": found}, labels, np.array([size] * 4), choice)
    np.testing.assert_allclose(moved["joints2d"], joints_of([size] * 4) + SHIFT, rtol=1e-12)
    metric = plugins.load_options(METRICS[1])
    assert metric.module.compute(moved, true, metric.options) == {"mpjpe2d_sensor_px": pytest.approx(5, abs=1e-3)}


def test_labels_move_to_the_centre_of_their_sensor_pixel_by_the_protocol_of_dhp19():
    choice, size = encoding("pad"), DAVIS
    points = np.full((1, 13, 2), [45.73, 124.21])
    labels = Labels(
        ("",), np.zeros(1, np.int64), in_image(points, size, choice).astype(np.float32), np.ones((1, 13), bool), "dhp19"
    )
    moved, true = on_sensor({"joints2d": in_image(points * 0 + [32.5, 132.5], size, choice)}, labels, [size], choice)
    metric = plugins.load_options(MetricChoice(name="mpjpe2d_sensor", options={"protocol": "dhp19"}))
    # DHP19's own example, of which test_metrics_of_poses.py tells.
    found = metric.module.compute(moved, true, metric.options)
    assert found == {"mpjpe2d_sensor_dhp19_px": pytest.approx(15.264, abs=5e-4)}


def recordings_of(folder, sizes):
    folder.mkdir(parents=True)
    count = len(sizes)
    numbers = ("num_events", "num_positive", "num_negative", "t_first_us", "t_last_us", "duration_us")
    columns = {
        "recording_id": list(sizes), "subject": [f"s {name}" for name in sizes], "class_name": [""] * count,
        "splits": ["condition" if name == "poses" else "test" for name in sizes],
        "sensor_width_px": pa.array([size[0] for size in sizes.values()], pa.int32()),
        "sensor_height_px": pa.array([size[1] for size in sizes.values()], pa.int32()),
        **dict.fromkeys(numbers, pa.array([1] * count, pa.int64())), "num_windows": pa.nulls(count, pa.int64()),
        "events_batch": pa.nulls(count, pa.int32()),
        **{name: [""] * count for name in ("events_file", "event_images_file", "intensity_file")},
    }  # fmt: skip
    return read_manifest(write_manifest(folder, pa.table(columns), tables.RECORDINGS))


def frames_of(folder, names, labels):
    folder.mkdir(parents=True)
    count = len(names)
    np.save(folder / "frames.npy", np.zeros((count, 64, 64, 3), np.uint8))
    columns = {
        "sample_id": [f"{name}:test:{row:05d}" for row, name in enumerate(names)], "recording_id": names,
        "subject": [f"s {name}" for name in names], "split": ["test"] * count, "class_name": [""] * count,
        **dict.fromkeys(("t_start_us", "t_end_us", "t_us", "num_events"), pa.array([1] * count, pa.int64())),
        **label_columns(labels),
    }  # fmt: skip
    return read_manifest(write_manifest(folder, pa.table(columns), tables.FRAMES))


def test_each_frame_of_a_union_is_measured_on_its_own_sensor(tmp_path, monkeypatch):
    sizes = {"part.near/a": DAVIS, "part.far/b": CELEX, "part.far/c": TALL}
    names = ["part.near/a", "part.far/b", "part.near/a", "part.far/c", "part.far/b"]
    labels, found = labelled([sizes[name] for name in names], encoding())
    monkeypatch.setattr(pose2d, "predict_sequences", lambda model, frames, recordings: {"joints2d": found})
    data, recordings = frames_of(tmp_path / "frames", names, labels), recordings_of(tmp_path / "recordings", sizes)
    (tmp_path / "out").mkdir()
    table = score_model.function(
        Output(tmp_path / "out", tmp_path), data, data, [], [], downstream=DownstreamChoice(name="pose2d"),
        metrics=METRICS, subject="recorded", split="test", seed=0, sensor=SensorSource(recordings, encoding()),
    )  # fmt: skip
    scores = {(row["group"], row["metric"]): row["value"] for row in table.to_pylist()}
    for group in ("all", "dataset near", "dataset far"):
        assert scores[group, "mpjpe2d_sensor_px"] == pytest.approx(5, abs=1e-3)
    # In the image the same shift is smaller the larger the sensor: 64 / 346 and 64 / 1280 or 64 / 400 of it.
    assert scores["dataset near", "mpjpe2d_px"] == pytest.approx(5 * 64 / 346, abs=1e-3)
    assert scores["dataset far", "mpjpe2d_px"] == pytest.approx(5 * np.mean([64 / 1280, 64 / 400, 64 / 1280]), abs=1e-3)


def test_synthetic_frames_are_on_the_sensor_that_their_label_was_mapped_from(tmp_path, monkeypatch):
    recordings = recordings_of(tmp_path / "recordings", {"a": DAVIS, "b": CELEX, "poses": TALL})
    table = pa.table({"source_id": ["b:train:00003", "poses:1500", "a:train:00000", "elsewhere:7"]})
    made = Manifest(ManifestRef(key="made", path=tmp_path), tables.SYNTHETIC, table, {})
    # The recordings are looked through once, not for each of many frames.
    first_sensor = Mock(wraps=sensor_size_of)
    monkeypatch.setattr(sensor_pixels, "sensor_size_of", first_sensor)
    # Labels of no frame were scaled onto the experiment's first sensor when they were chosen.
    assert sensor_sizes(made, np.arange(4), recordings).tolist() == [[*CELEX], [*DAVIS], [*DAVIS], [*DAVIS]]
    first_sensor.assert_called_once()


def test_a_frame_without_a_sensor_is_refused(tmp_path):
    recordings = recordings_of(tmp_path / "recordings", {"a": (0, 0)})
    labels, _ = labelled([DAVIS], encoding())
    with pytest.raises(DataError, match=r"row 0: a has no sensor size in .*recordings"):
        sensor_sizes(frames_of(tmp_path / "frames", ["a"], labels), np.arange(1), recordings)


def test_metrics_in_the_image_keep_their_keys_and_others_need_the_sensor(home):
    def keys(metrics):
        with planning() as rows:
            call_flow(evaluate, load_preset(Experiment, PRESETS, "smoke", [f"metrics={metrics}"]))
        return {row.label: row for row in rows if row.stage == "score_model"}

    image, both = keys("[{name: mpjpe2d}]"), keys("[{name: mpjpe2d}, {name: mpjpe2d_sensor}]")
    assert set(image) == set(both) and not {r.key for r in image.values()} & {r.key for r in both.values()}
    assert all("sensor" not in row.arguments for row in image.values())
    assert all(row.arguments["sensor"]["encoding"]["plugin"] == "encodings/event_histogram" for row in both.values())
    ref = ManifestRef(key="planned", path=home)
    with planning(), pytest.raises(DataError, match="needs the argument `sensor`"):
        score_model(
            ref, ref, [], [], downstream=DownstreamChoice(name="pose2d"), metrics=METRICS, subject="a", split="test",
            seed=0,
        )  # fmt: skip
    with pytest.raises(PluginError, match="keep_fraction goes by the first of metrics"):
        keys("[{name: mpjpe2d_sensor}]")
    check_in_image(METRICS[0], "keep_fraction")
