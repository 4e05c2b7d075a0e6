"""The code of docs/extending.md: each block is put where its first line says, loaded by name, and used."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ctlev_core import plugin_contracts, plugins
from ctlev_core.body.motion import files as motion_files
from ctlev_core.events import files as event_files
from ctlev_core.events.windows import cut
from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.labels.labelling import labels_at_windows, labels_in_image
from ctlev_core.report.sections import verdict
from ctlev_core.scoring.score_info import ScoreInfo, lower_is_better
from ctlev_core.statistics.paired_differences import Difference
from data_contracts.config import Frozen, Windows
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, check_events
from data_contracts.experiment import Experiment
from data_contracts.image_rows import ImageRows
from data_contracts.labels import Labels

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = (REPOSITORY / "docs" / "extending.md").read_text(encoding="utf-8")
BLOCKS = {
    (match[1], match[2]): match[0]
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    if (match := re.match(r"# ctlev_core/(\w+)/(\w+)\.py\n.*", block, re.DOTALL))
}
SIZE = (40, 30)
NUM_JOINTS = len(JOINT_SETS["dhp19"].joints)
EVENTS_A_WINDOW = 200


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory):
    """The blocks as files that the loader finds as if they lay in the package, and no longer after these tests."""
    folder = tmp_path_factory.mktemp("plugins")
    with pytest.MonkeyPatch.context() as patch:
        for (kind, name), code in BLOCKS.items():
            path = folder / kind / f"{name}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(code, encoding="utf-8")
            package = importlib.import_module(f"ctlev_core.{kind}")
            patch.setattr(package, "__path__", [*package.__path__, str(path.parent)])
        importlib.invalidate_caches()
        yield folder
    for kind, name in BLOCKS:
        sys.modules.pop(f"ctlev_core.{kind}.{name}", None)
        vars(importlib.import_module(f"ctlev_core.{kind}")).pop(name, None)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two recordings of three subjects each; 13 points stand in a grid that drifts, and each sends events."""
    folder = tmp_path_factory.mktemp("markers")
    random = np.random.default_rng(0)
    for subject in ("anna", "ben", "carl"):
        (folder / subject).mkdir()
        for motion in ("left", "right"):
            events, t_us, joints = drifting_points(random, -1 if motion == "left" else 1)
            write_plain16(folder / subject / f"{motion}.ev16", events)
            table = np.column_stack([t_us, joints.reshape(len(t_us), -1)])
            np.savetxt(folder / subject / f"{motion}.joints.csv", table, delimiter=",")
    return folder


def drifting_points(random: np.random.Generator, direction: int) -> tuple[Events, np.ndarray, np.ndarray]:
    """Events [2,000], and the points [21, 13, 2] at times [21] us."""
    t_us = np.arange(0, 100_001, 5_000)
    start = np.stack(np.meshgrid(np.arange(8, 33, 6), np.arange(6, 25, 6)), axis=-1).reshape(-1, 2)[:NUM_JOINTS] + 0.5
    joints = start + np.stack([direction * 5e-5 * t_us, np.zeros(len(t_us))], axis=-1)[:, None]
    t = np.sort(random.integers(0, 100_000, 2000))
    joint = random.integers(0, NUM_JOINTS, len(t))
    x = start[joint, 0] + direction * 5e-5 * t
    columns = t, x, start[joint, 1], random.integers(0, 2, len(t))
    typed = {n: np.floor(column).astype(EVENT_DTYPES[n]) for n, column in zip(EVENT_DTYPES, columns, strict=True)}
    return check_events(Events(**typed, sensor_size=SIZE), "points"), t_us, joints


def write_plain16(path: Path, events: Events) -> None:
    records = np.zeros(len(events), [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "<u4")])
    for name in EVENT_DTYPES:
        records[name] = getattr(events, name)
    path.write_bytes(b"EV16" + np.array(events.sensor_size, "<u2").tobytes() + records.tobytes())


def on_disk(frames: np.ndarray) -> ImageRows:
    """Frames as stages hand them to `train` and `predict`."""
    return ImageRows.of([(frames, np.arange(len(frames)))])


def load(kind: str, name: str, **options):
    module = plugins.load(kind, name)
    return module, plugins.validate_options(module.Options, options, name)


@pytest.fixture(scope="module")
def chain(root):
    """Frames [N, H, W, 3], labels and conditions of `train` and of `test`, through the page's plug-ins."""
    dataset, options = load("datasets", "marker_folder", root=root, test_subjects=["anna"])
    encoding, fit = load("encodings", "touched", image_size=(32, 32))
    condition, asked = load("conditions", "box")
    found: dict[str, list[tuple[np.ndarray, Labels]]] = {"train": [], "test": []}
    for recording in dataset.list_recordings(options):
        events = dataset.read_events(recording, options)
        windows = cut(events, Windows(method="count", num_events=EVENTS_A_WINDOW))
        frames = encoding.render_image(encoding.encode(events, windows, fit), fit)
        starts, ends = events.t[windows[:, 0]], events.t[windows[:, 1] - 1]
        labels = labels_at_windows(dataset.read_labels(recording, options), starts, ends)
        labels = labels_in_image(labels, lambda points: encoding.map_points(points, SIZE, fit), (32, 32))
        found[recording.parts[0].split].append((frames, labels))
    made = {}
    for split, rows in found.items():
        frames = np.concatenate([frames for frames, _ in rows])
        labels = Labels(
            tuple(name for _, labels in rows for name in labels.class_names),
            *(np.concatenate([getattr(one, name) for _, one in rows]) for name in ("t_us", "joints2d", "visible")),
            joint_set="dhp19",
        )
        made[split] = frames, labels, condition.render(labels, (32, 32), asked, range(len(labels)))
    return made


def test_there_is_an_example_of_every_kind():
    assert sorted(kind for kind, _ in BLOCKS) == sorted(plugins.KINDS)
    assert len(re.findall("```python", PAGE)) == len(BLOCKS)


@pytest.mark.parametrize(("kind", "name"), sorted(BLOCKS))
def test_examples_keep_their_contracts(kind, name):
    module, protocol = plugins.load(kind, name), plugin_contracts.BY_KIND[kind][0]
    assert module.VERSION >= 1 and module.__doc__
    assert all(hasattr(module, attribute) for attribute in protocol.__annotations__)
    for function, expected in inspect.getmembers(protocol, inspect.isfunction):
        if function.startswith("_"):
            continue
        wanted = list(inspect.signature(expected).parameters.values())[1:]
        got = list(inspect.signature(getattr(module, function)).parameters.values())[: len(wanted)]
        assert [(p.name, p.kind) for p in got] == [(p.name, p.kind) for p in wanted], function
        assert getattr(module, function).__doc__, function
    for model in (getattr(module, name, None) for name in ("Options", "SampleOptions")):
        assert model is None or issubclass(model, Frozen)
        assert model is None or all(info.description for info in model.model_fields.values())


def test_examples_import_nothing_heavy(installed):
    heavy = "{'torch', 'numba', 'cv2', 'diffusers', 'transformers', 'scipy', 'prefect'}"
    code = "import sys\n" + "".join(
        f"import ctlev_core.{kind}\nctlev_core.{kind}.__path__.append({str(installed / kind)!r})\n"
        f"import ctlev_core.{kind}.{name}\n"
        for kind, name in BLOCKS
    )
    code += f"print(sorted({heavy} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert result.stdout.strip() == "[]"


def test_the_page_names_every_function_of_the_contracts():
    contracts = [value for value in vars(plugin_contracts).values() if getattr(value, "_is_protocol", False)]
    functions = {name for contract in contracts for name, _ in inspect.getmembers(contract, inspect.isfunction)}
    attributes = {name for contract in contracts for name in contract.__annotations__}
    assert len(contracts) >= 20
    prose = re.sub("```.*?```", "", PAGE, flags=re.DOTALL)
    assert not [name for name in functions | attributes if name[0] != "_" and not re.search(rf"\b{name}\b", prose)]


def test_a_new_metric_says_itself_what_its_scores_are():
    """Nothing but its own file names it: tables, verdicts and gates know the direction and the words all the same."""
    assert lower_is_better("worst_joint_px") and not lower_is_better("best_joint_px")
    values = {"recorded": 6.0, "recorded+synthetic": 5.0}
    about = {"metric": "worst_joint_px", "group": "all"}
    rows = [{"subject": name, "value": value, **about} for name, value in values.items()]
    told = str(verdict.verdict(rows, list(values), Difference(-1.0, -1.5, -0.5)))
    assert "mean error of a frame's worst joint, in pixels. Less is better." in told
    assert "helped: worst joint px went from 6.000 to 5.000, a difference of -1.000 [-1.500, -0.500]" in told
    better = verdict.made_better(Difference(-1.0, -1.5, -0.5), "worst_joint_px")
    assert better and not verdict.made_better(Difference(1.0, 0.5, 1.5), "worst_joint_px")


def test_every_metric_says_what_its_scores_are():
    for name in plugins.names("metrics"):
        scores = plugins.load("metrics", name).SCORES
        assert scores and all(isinstance(info, ScoreInfo) and info.start for info in scores), name


def test_the_dataset_reads_recordings_and_labels(root, tmp_path):
    dataset, options = load("datasets", "marker_folder", root=root, test_subjects=["anna"])
    recordings = dataset.list_recordings(options)
    assert [r.recording_id for r in recordings] == [
        f"{s}/{m}" for s in ("anna", "ben", "carl") for m in ("left", "right")
    ]
    assert [r.parts[0].split for r in recordings] == ["test"] * 2 + ["train"] * 4
    labels = dataset.read_labels(recordings[1], options)
    events, t_us, joints = drifting_points(np.random.default_rng(0), 1)
    np.testing.assert_array_equal(labels.t_us, t_us)
    np.testing.assert_allclose(labels.joints2d, joints, rtol=1e-6)
    (tmp_path / "dan").mkdir()
    (tmp_path / "dan" / "run.joints.csv").write_text("0, 1, 2\n")
    wrong = options.model_copy(update={"root": tmp_path})
    with pytest.raises(DataError, match="expected one recording run"):
        dataset.list_recordings(wrong)
    write_plain16(tmp_path / "dan" / "run.ev16", events.slice(0, 1))
    (recording,) = dataset.list_recordings(wrong)
    with pytest.raises(DataError, match="expected 27 numbers a row, got 3"):
        dataset.read_labels(recording, wrong)


def test_the_format_is_found_and_read_whole_and_in_chunks(tmp_path):
    events, _, _ = drifting_points(np.random.default_rng(1), 1)
    path = tmp_path / "recording.bin"
    write_plain16(path, events)
    found = event_files.find_format(path)
    assert found.__name__ == "ctlev_core.formats.plain16"
    whole, chunks = found.read(path), list(found.read_chunks(path, 300))
    assert [len(chunk) for chunk in chunks] == [300] * 6 + [200]
    for name in EVENT_DTYPES:
        np.testing.assert_array_equal(getattr(whole, name), getattr(events, name))
        np.testing.assert_array_equal(np.concatenate([getattr(chunk, name) for chunk in chunks]), getattr(events, name))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DataError, match="the last record is cut, 15 bytes of 16"):
        found.read(path)


def test_the_motion_format_is_found_and_read(tmp_path):
    path = tmp_path / "turn.json"
    path.write_text('{"turntable": 1, "rate_hz": 10, "root": [[0, 0, 0, 1, 2, 3], [0, 1.5, 0, 1, 2, 4]]}')
    clip = motion_files.read_motion(path)
    np.testing.assert_array_equal(clip.pose[:, :3], [[0, 0, 0], [0, 1.5, 0]])
    assert not clip.pose[:, 3:].any() and clip.transl[1].tolist() == [1, 2, 4] and clip.time_s.tolist() == [0, 0.1]
    path.write_text('{"turntable": 1, "rate_hz": 0, "root": []}')
    with pytest.raises(DataError, match="expected root"):
        motion_files.read_motion(path)


def test_the_encoding_marks_the_pixels_with_events():
    encoding, options = load("encodings", "touched")
    events, _, _ = drifting_points(np.random.default_rng(2), -1)
    images = encoding.render_image(encoding.encode(events, np.array([[0, 100], [100, 150]]), options), options)
    for image, (start, stop) in zip(images, ((0, 100), (100, 150)), strict=True):
        expected = np.zeros((30, 40), np.uint8)
        for x, y in zip(events.x[start:stop], events.y[start:stop], strict=True):
            expected[y, x] = 255
        np.testing.assert_array_equal(image, np.repeat(expected[..., None], 3, axis=-1))


def test_the_condition_draws_the_box(chain):
    _, labels, conditions = chain["train"]
    assert labels.joints2d is not None and labels.visible is not None
    seen = labels.joints2d[0][labels.visible[0]]
    rows, columns = np.nonzero(conditions.images[0, ..., 0])
    (left, top), (right, bottom) = seen.min(axis=0).astype(int), seen.max(axis=0).astype(int)
    assert (left, top, right, bottom) == (columns.min(), rows.min(), columns.max(), rows.max())
    assert len(rows) == (right - left + 1) * (bottom - top + 1)


def test_the_generator_gives_training_frames_whatever_the_batch(chain, tmp_path):
    generator, options = load("generators", "nearest")
    frames, _, conditions = chain["train"]
    _, _, asked = chain["test"]
    generator.train(on_disk(frames), conditions, options, seed=0, out=tmp_path / "checkpoint", work=tmp_path)
    sample_options = generator.SampleOptions(num_nearest=3)
    seeds = list(range(len(asked)))
    made = generator.sample(tmp_path / "checkpoint", asked, sample_options, seeds=seeds, work=tmp_path)
    assert all((frames == frame).all(axis=(1, 2, 3)).any() for frame in made)
    alone = generator.sample(
        tmp_path / "checkpoint", asked.take(slice(5, 6)), sample_options, seeds=seeds[5:6], work=tmp_path
    )
    np.testing.assert_array_equal(alone[0], made[5])


def test_the_model_learns_where_the_points_are(chain, tmp_path):
    model, options = load("downstream", "linear_pose")
    frames, labels, _ = chain["train"]
    held_out, target, _ = chain["test"]
    model.train(on_disk(frames), labels, options, seed=0, out=tmp_path / "model", work=tmp_path)
    predicted = model.predict(tmp_path / "model", on_disk(held_out))
    metric, none = load("metrics", "worst_joint")
    assert target.joints2d is not None and labels.joints2d is not None
    score = metric.compute(predicted, target, none)["worst_joint_px"]
    always_the_mean = {"joints2d": np.broadcast_to(labels.joints2d.mean(axis=0), target.joints2d.shape)}
    # The points drift by up to 4 px of the image to either side, so that the mean errs by about 2 px.
    assert score < 0.5 * metric.compute(always_the_mean, target, none)["worst_joint_px"]


def test_the_metric_takes_the_worst_visible_joint():
    metric, none = load("metrics", "worst_joint")
    visible = np.array([[True, True, False], [True, False, False], [False, False, False]])
    target = Labels(("",) * 3, np.zeros(3, np.int64), np.zeros((3, 3, 2), np.float32), visible)
    predicted = {"joints2d": np.array([[[3, 4], [1, 0], [9, 9]], [[0, 2], [8, 8], [8, 8]], [[7, 7]] * 3], float)}
    np.testing.assert_array_equal(metric.compute_rows(predicted, target, none), [5, 2, np.nan])
    assert metric.compute(predicted, target, none) == {"worst_joint_px": 3.5}


def test_the_preset_is_valid(root, tmp_path):
    from flows.command_line import PRESETS, load_preset

    (preset,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    path = tmp_path / "mine.yaml"
    path.write_text(preset)
    experiment = load_preset(Experiment, PRESETS, str(path), [f"dataset.options.root={root}"])
    used = {(choice.KIND, plugins.load_options(choice).name) for choice in experiment.choices}
    assert used >= {key for key in BLOCKS if key[0] not in ("formats", "motions")}
