"""Event-HPE as it is released: finished event images of windows whose length its options say."""

import cv2
import joblib
import numpy as np
import pytest

from data_contracts.config import ConditionChoice, DatasetChoice, EncodingChoice, Windows
from data_contracts.manifest import conditions_of, read_manifest
from tasks.condition import condition_frames, condition_samples
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.store import Store

COUNT, PERIOD_US = 8, 15_000
ENCODING = EncodingChoice(name="event_histogram", options={"polarity": False})
WINDOWS = Windows(method="duration", duration_us=PERIOD_US, anchor="labels")


def run(stage, *inputs, **settings):
    bound = stage.signature.bind(None, *inputs, **settings)
    bound.apply_defaults()
    arguments = dict(list(bound.arguments.items())[1:])
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), content)


@pytest.fixture
def encoded(home, tmp_path):
    """Grey picture n has the value 20 n; event image n, between pictures n and n + 1, has its own row."""
    root = tmp_path / "released"
    joints, pixels = np.tile([0.0, 0.0, 3.0], (24, 1)), np.tile([128.0, 128.0, 3.0], (24, 1))
    for subject in (1, 3, 5):
        action = f"subject{subject:02d}_group1_time1"
        (root / "pose_events" / action).mkdir(parents=True)
        for number in range(COUNT + 1):
            pose = np.full((1, 72), 0.01 * number), np.array([[0, 0, 3.0 + 0.001 * number]])
            path = root / f"pose_events/{action}/pose{number:04d}.pkl"
            joblib.dump((np.zeros((1, 10)), *pose, joints, pixels), path)
            write(root / f"full_pic_256/{action}/fullpic{number:04d}.jpg", np.full((256, 256), 20 * number, np.uint8))
            if number < COUNT:
                slices = np.zeros((256, 256, 4), np.uint8)
                slices[100:110, 100:110, number % 4] = slices[5 * number, 7, 0] = 1
                write(root / f"events_256/{action}/event{number:04d}.png", slices)
    options = {"root": str(root), "condition_subjects": [5], "frame_period_us": PERIOD_US}
    recordings = run(ingest, dataset=DatasetChoice(name="event_hpe", options=options))
    return recordings, run(encode, recordings, encoding=ENCODING, windows=WINDOWS)


def test_the_pictures_of_a_pair_are_those_before_and_after_the_events(encoded):
    recordings, frames = encoded
    made = read_manifest(
        run(
            condition_frames,
            recordings,
            frames,
            condition=ConditionChoice(name="intensity_pair"),
            encoding=ENCODING,
            seed=0,
        )
    )
    shown, images = read_manifest(frames), conditions_of(made).images
    row_of = {name: row for row, name in enumerate(shown.column("sample_id"))}
    assert len(made) == 8
    for row, name in enumerate(made.column("sample_id")):
        own = np.asarray(shown.array("frames")[row_of[name]])[..., 0]
        number = int(np.flatnonzero(own[:, 7])[0] // 5)
        assert np.rint(images[row, 0, 0, :2] / 20).tolist() == [number, number + 1]
    table = shown.table.to_pylist()[0]
    assert table["t_end_us"] - table["t_start_us"] == PERIOD_US - 1


@pytest.mark.parametrize("condition", ["body_motion", "moving_body"])
def test_bodies_are_seen_to_move(encoded, condition):
    recordings, frames = encoded
    settings = {"windows": WINDOWS, "count": 4, "order": "random", "views": "labelled", "seed": 0}
    choice = ConditionChoice(name=condition)
    made = run(condition_samples, recordings, recordings, frames, condition=choice, encoding=ENCODING, **settings)
    assert made.rows == 4
