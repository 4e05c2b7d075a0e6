"""Two real frames of DHP19 with their labels, through the dataset's layout `frames` and the encoding, as in a run.

The frames hold counts that DHP19's code has already normalised by three standard deviations.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from ctlev_core.dataset_files import dhp19_files
from ctlev_core.geometry import camera as cameras
from data_contracts.config import DatasetChoice, EncodingChoice, Windows
from data_contracts.manifest import read_manifest
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.store import Store

REAL_DATA = Path(__file__).resolve().parents[3].parent / "shared" / "real"
CAMERAS = (2, 3)
PRINTED = REAL_DATA / "dhp19_frames" / "printed_coordinates.txt"


@pytest.fixture
def pictures() -> np.ndarray:
    """[2, 260, 344] uint8 of the cameras 2 and 3."""
    paths = [REAL_DATA / "dhp19_frames" / f"frame_cam{number}.png" for number in CAMERAS]
    for path in (*paths, PRINTED, REAL_DATA / "dhp19_calib" / "P2.npy"):
        if not path.is_file():
            pytest.skip(f"{path.name} of DHP19's authors is not part of the repository")
    return np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths])


@pytest.fixture
def printed(pictures) -> np.ndarray:
    """[2, 13, 2] (column, row) of the pixels that the labels lie in, as the authors print them; rows from the top."""
    found = re.findall(r"GT: \[\s*(\d+)\s+(\d+)\]", PRINTED.read_text())
    return np.array(found, np.float64).reshape(2, 13, 2)[..., ::-1]


@pytest.fixture
def root(tmp_path, pictures, printed) -> Path:
    """What the authors' MATLAB code writes: one frame of the four cameras' channels, and its label in mm.

    The frame is of subject 16, to test on; a copy of it as subject 1 is there because a run needs something to learn.
    """
    shutil.copytree(REAL_DATA / "dhp19_calib", tmp_path / "dhp19" / "P_matrices")
    matrices = [tmp_path / "dhp19" / "P_matrices" / f"P{number}.npy" for number in CAMERAS]
    views = [dhp19_files.camera_of(dhp19_files.read_projection(path), str(path)) for path in matrices]
    # Their 3D label was not printed: what both cameras see in the middle of the printed pixels takes its place.
    points_m = cameras.triangulate(views, printed + 0.5)
    frames = np.zeros((1, *pictures.shape[1:], dhp19_files.NUM_CAMERAS))
    for number, picture in zip(CAMERAS, pictures, strict=True):
        frames[0, ..., dhp19_files.CHANNEL_OF_CAMERA[number]] = picture
    folder = tmp_path / "dhp19" / "h5_dataset_7500_events" / "346x260"
    folder.mkdir(parents=True)
    for subject in (1, 16):
        with h5py.File(folder / f"S{subject}_session2_mov1_7500events.h5", "w") as file:
            file["DVS"] = frames
        with h5py.File(folder / f"S{subject}_session2_mov1_7500events_label.h5", "w") as file:
            file["XYZ"] = 1000 * points_m.T[None]
    return tmp_path / "dhp19"


def run_stage(stage, **arguments):
    """What a Prefect task does, without Prefect."""
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def encoded(root, **options):
    """Frames [2, H, W, 3] and joints [2, 13, 2] of subject 16."""
    recordings = run_stage(ingest, dataset=DatasetChoice(name="dhp19", options={"root": str(root)}))
    choice = EncodingChoice(name="event_histogram", options={"polarity": False, **options})
    frames = read_manifest(run_stage(encode, recordings=recordings, encoding=choice, windows=Windows(num_events=7500)))
    rows = [row for row, name in enumerate(frames.column("recording_id")) if name.startswith("S16/")]
    assert [frames.column("recording_id")[row] for row in rows] == [f"S16/session2/mov1/cam{n}" for n in CAMERAS]
    assert {frames.column("split")[row] for row in rows} == {"test"}
    labels = frames.labels.take(np.array(rows))
    assert labels.joints2d is not None and labels.visible is not None and labels.visible.all()
    return np.asarray(frames.array("frames"))[rows], labels.joints2d


def test_frames_of_their_own_size_arrive_unchanged_by_the_normalisation_max(home, root, pictures):
    images, _ = encoded(root, normalisation="max")
    assert images.dtype == np.uint8
    np.testing.assert_array_equal(images, np.repeat(pictures[..., None], 3, axis=-1))


def test_at_their_own_size_frames_stay_as_their_authors_normalised_them(home, root, pictures):
    images, _ = encoded(root, normalisation="three_sigma")
    np.testing.assert_array_equal(images, np.repeat(pictures[..., None], 3, axis=-1))


def test_labels_lie_in_the_printed_pixels(home, root, printed):
    _, joints = encoded(root, normalisation="max")
    np.testing.assert_array_equal(np.floor(joints), printed)


def test_frames_and_labels_are_scaled_to_512_px_together(home, root, printed):
    images, joints = encoded(root, normalisation="max", image_size=[512, 512])
    # 344 onto 512 px, and bars above and below: (512 - 260 * 512 / 344) / 2 = 62.51 px.
    assert images.shape == (2, 512, 512, 3)
    assert not images[:, :62].any() and not images[:, -62:].any() and images[:, 62:-62].any()
    # The labels are within .36 px of the middle of their printed pixels.
    np.testing.assert_allclose(joints, (printed + 0.5) * 512 / 344 + [0, 62.51], atol=0.37 * 512 / 344)
