"""Two datasets as one: what each gives, under names that tell them apart."""

import numpy as np
import pytest
from pydantic import ValidationError

from ctlev_core import plugins
from ctlev_core.geometry.joint_sets import joint_indices
from ctlev_core.labels.label_sampling import balanced_choice, spread_choice
from ctlev_core.plugins import PluginError
from ctlev_core.scoring.subsets import part_groups
from data_contracts import tables
from data_contracts.config import DatasetChoice, EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.manifest import read_manifest
from data_contracts.parts import part_of
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.stage import planning
from tasks.store import Store

SMALL = {"num_train_recordings": 2, "num_test_recordings": 1, "num_condition_recordings": 2}
NEAR = DatasetChoice(name="studio", options={**SMALL, "seed": 1})
FAR = DatasetChoice(name="studio", options={**SMALL, "seed": 2, "sensor_size": [96, 64]})


def union(**options):
    return DatasetChoice(name="union", options={"parts": {"near": NEAR, "far": FAR}, **options})


def both(choice=None):
    plugin = plugins.load_options(choice or union())
    return plugin.module, plugin.options


def run(stage, **arguments):
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def test_recordings_are_those_of_the_parts_under_names_of_their_own():
    module, options = both()
    found = module.list_recordings(options)
    expected = []
    for name, part in (("near", NEAR), ("far", FAR)):
        plugin = plugins.load_options(part)
        for own in plugin.module.list_recordings(plugin.options):
            expected.append((f"part.{name}/{own.recording_id}", f"part.{name}/{own.subject}", own.parts))
    assert [(one.recording_id, one.subject, one.parts) for one in found] == expected
    assert {part_of(one.recording_id) for one in found} == {"near", "far"} and part_of("train/walk_1") == ""


@pytest.mark.parametrize("part", ["near", "far"])
def test_events_and_labels_are_those_of_the_part(part):
    module, options = both()
    recording = next(one for one in module.list_recordings(options) if part_of(one.recording_id) == part)
    own = plugins.load_options(options.parts[part])
    original = own.module.list_recordings(own.options)[0]
    events = own.module.read_events(original, own.options)
    (chunk,) = module.read_event_chunks(recording, options)
    for read in (module.read_events(recording, options), chunk):
        assert read.sensor_size == events.sensor_size
        for name in "txyp":
            np.testing.assert_array_equal(getattr(read, name), getattr(events, name))
    labels, expected = module.read_labels(recording, options), own.module.read_labels(original, own.options)
    np.testing.assert_array_equal(labels.joints2d, expected.joints2d)
    assert module.read_windows(recording, options) is None and module.read_window_labels(recording, options) is None


def test_joints_come_in_the_order_that_is_asked_for():
    module, options = both()
    reordered, asked = both(union(joint_set="cdehp"))
    recording = module.list_recordings(options)[0]
    before, after = module.read_labels(recording, options), reordered.read_labels(recording, asked)
    order = joint_indices(before.joint_set, "cdehp")
    assert after.joint_set == "cdehp" and after.joints2d.shape[1] == 13
    np.testing.assert_array_equal(after.joints2d, before.joints2d[:, order])
    np.testing.assert_array_equal(after.visible, before.visible[:, order])


def test_parts_must_have_labels_of_one_kind():
    module, options = both(union(parts={"near": NEAR, "objects": {"name": "studio_objects"}}))
    with pytest.raises(DataError, match=r"expected labels of one kind in all parts, got near: joints2d.*classes alone"):
        module.list_recordings(options)


def test_sensors_of_two_sizes_become_frames_of_one_that_are_scored_apart(home):
    recordings = run(ingest, dataset=union())
    encoding = EncodingChoice(name="event_histogram", options={"polarity": False, "image_size": [64, 64]})
    frames = read_manifest(
        run(encode, recordings=recordings, encoding=encoding, windows=Windows(num_events=300, max_windows=2))
    )
    assert frames.array("frames").shape[1:] == (64, 64, 3) and frames.array("histograms").shape[-2:] == (64, 96)
    groups = dict(part_groups(frames.column("recording_id")))
    assert set(groups) == {"dataset near", "dataset far"}
    assert sum(len(rows) for rows in groups.values()) == len(frames)
    assert part_groups(["test/a", "test/b"]) == [] and part_groups(["part.a/1", "part.a/2"]) == []
    assert read_manifest(recordings).attached(tables.WINDOWS).num_rows == 0


def test_each_part_has_an_equal_share_of_what_is_chosen():
    recordings = [f"part.a/{number % 3}" for number in range(30)] + [f"part.b/{number % 2}" for number in range(6)]
    classes = [["walk", "run", "kick"][number % 3] for number in range(36)]
    asked = balanced_choice(classes, recordings, 11, seed=0)
    assert [part_of(recordings[row]) for row in asked] == ["a", "b"] * 5 + ["a"]
    alone = balanced_choice(classes[:30], [name.partition("/")[2] for name in recordings[:30]], 6, seed=0)
    np.testing.assert_array_equal(asked[::2], alone)
    for count, shares in ((8, (4, 4)), (20, (14, 6)), (36, (30, 6))):
        rows = spread_choice(classes, recordings, count, seed=0)
        names = [part_of(recordings[row]) for row in rows]
        assert (names.count("a"), names.count("b")) == shares and len(set(rows.tolist())) == count


def key_of(choice):
    with planning() as rows:
        ingest(dataset=choice)
    return rows[0].key, rows[0].arguments["dataset"]["options"]["parts"]["far"]


def test_the_key_holds_what_the_parts_are_and_which_version_they_have(home, monkeypatch):
    key, material = key_of(union())
    assert material["plugin"] == "datasets/studio" and material["version"] == plugins.load("datasets", "studio").VERSION
    assert key_of(union())[0] == key
    changed = FAR.model_copy(update={"options": {**FAR.options, "seed": 3}})
    assert key_of(union(parts={"near": NEAR, "far": changed}))[0] != key
    monkeypatch.setattr(plugins.load("datasets", "studio"), "VERSION", 99)
    assert key_of(union())[0] != key


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"parts": {"near": NEAR}}, DataError, "expected two or more datasets under parts, got 1"),
        ({"parts": {"a/b": NEAR, "far": FAR}}, PluginError, "letters, digits, '_' and '-' alone, got 'a/b'"),
        ({"parts": {"near": NEAR, "u": {"name": "union"}}}, PluginError, "part 'u' is a union itself"),
        ({"joint_set": "hands"}, PluginError, "unknown joint set; known: dhp19"),
        ({"parts": {"near": NEAR, "far": {"name": "studioo"}}}, PluginError, "unknown plug-in 'studioo'"),
    ],
)
def test_what_is_no_union_is_refused(options, error, message):
    with pytest.raises((error, ValidationError), match=message):
        module, chosen = both(union(**options))
        module.list_recordings(chosen)
