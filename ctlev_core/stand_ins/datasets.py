"""A few made-up recordings of each dataset of the paper, in its published layout and of its sensor's size.

People move as `people` says, and labels are where they are; things are outlines on a screen that is shaken. Rates of
events are those of the datasets, in round numbers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv

from ctlev_core.body.layer import BUNDLED_BODY
from ctlev_core.body.motion.clip import Y_UP_TO_Z_UP, move_world
from ctlev_core.dataset_files import cdehp_files, dhp19_files, event_hpe_files
from ctlev_core.datasets import n_caltech101, n_imagenet
from ctlev_core.geometry.camera import Camera, project
from ctlev_core.geometry.joint_sets import SMPL_TO_DHP19, joint_indices
from ctlev_core.stand_ins import dataset_writers as writers
from ctlev_core.stand_ins.people import draw_events, draw_grey_picture, move_person, person_of

DHP19_SUBJECTS = (1, 2, 3, 4, 11, 12, 13, 14)
DHP19_EVENTS = 120_000
"""Of four cameras in 1.2 s: four windows of 30,000."""
DHP19_START_US = 5_000_000
CDEHP_PEOPLE = {"train": (1, 2, 3, 4, 5), "valid": (6, 7)}
CDEHP_FRAMES, CDEHP_RATE_HZ, CDEHP_EVENTS = 12, 120, 8_000
"""Labelled event images of a shot, their rate, and the events of each."""
EVENT_HPE_SUBJECTS = (1, 2, 3, 4, 5, 6)
EVENT_HPE_FRAMES, EVENT_HPE_RATE_HZ, EVENT_HPE_EVENTS = 8, 15, 20_000
"""Poses of an action, their rate, and the events between two."""
N_IMAGENET_NAMES = {
    "n01440764": "tench, Tinca tinca",
    "n02012849": "crane",
    "n02123045": "tabby, tabby cat",
    "n02690373": "airliner",
    "n03126707": "crane",
    "n04380533": "table lamp",
}
N_IMAGENET_PICTURES = {"extracted_train": 4, "extracted_val": 2}
N_CALTECH101_PICTURES = 8
"""Of each of the ten classes of the paper's Table 5."""
THING_EVENTS = 30_000
AMASS_MOTIONS, AMASS_RATE_HZ = 3, 120


def write_dhp19(root: Path) -> None:
    """Raw DHP19: one movement of eight subjects, four cameras, motion capture."""
    for camera in (1, 2, 3, 4):
        path = root / "P_matrices" / f"P{camera}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, writers.dhp19_projection(camera))
    num_rows = 121
    duration_us = (num_rows - 1) * dhp19_files.VICON_PERIOD_US
    for subject in DHP19_SUBJECTS:
        person = move_person(subject, num_rows, 1e6 / dhp19_files.VICON_PERIOD_US)
        person = person_of(move_world(person.clip, Y_UP_TO_Z_UP, np.zeros(3)))
        records = []
        for camera, channel in dhp19_files.CHANNEL_OF_CAMERA.items():
            view = dhp19_files.camera_of(writers.dhp19_projection(camera), f"P{camera}")
            events = draw_events(view, person, DHP19_EVENTS // dhp19_files.NUM_CAMERAS, 10 * subject + camera)
            columns = (column.astype(np.int64) for column in (events.x, events.y, events.p))
            records.append(np.stack([writers.dhp19_address(channel, *columns), events.t + DHP19_START_US + 1], axis=1))
        joined = np.concatenate(records)
        joined = joined[np.argsort(joined[:, 1], kind="stable")]
        triggers = [(writers.DHP19_SPECIAL, DHP19_START_US + time) for time in (0, 0, duration_us + 2)]
        writers.write_aedat2(
            root / f"DVS_movies/S{subject}/session1/mov1.aedat", [*triggers[:2], *joined.tolist(), triggers[2]]
        )
        joints = writers.dhp19_joints(1000 * person.joints[:, SMPL_TO_DHP19])
        writers.write_dhp19_vicon(root / f"Vicon_data/S{subject}_1_1.mat", joints)


def write_cdehp(root: Path) -> None:
    """CDEHP: event images, colour pictures and labels of a shot of seven people."""
    cameras = {
        "event": _camera(900.0, cdehp_files.SENSOR_SIZE, 3.0),
        "color": _camera(600.0, cdehp_files.COLOUR_SIZE, 3.0),
    }
    order = joint_indices("smpl", "cdehp")
    for folder, people in CDEHP_PEOPLE.items():
        for number in people:
            shot = root / "outdoor" / folder / f"A0001P{number:04d}S00"
            person = move_person(number, CDEHP_FRAMES + 1, CDEHP_RATE_HZ)
            joints = {name: project(camera, person.joints[:, order]) for name, camera in cameras.items()}
            events = draw_events(cameras["event"], person, CDEHP_FRAMES * CDEHP_EVENTS, number)
            frame = np.minimum(events.t // cdehp_files.WINDOW_US, CDEHP_FRAMES - 1)
            for i in range(CDEHP_FRAMES):
                width, height = cdehp_files.SENSOR_SIZE
                picture = np.zeros((height, width), np.uint8)
                picture[events.y[frame == i], events.x[frame == i]] = 255
                writers.write_picture(shot / f"event_image/{i:06d}.png", picture)
                name, partner = f"event_label/{i:06d}.txt", f"color_name:{i // 2:06d}"
                writers.write_cdehp_label(shot / name, joints["event"][i + 1], partner)
            for i in range(CDEHP_FRAMES // cdehp_files.EVENT_FRAMES_A_COLOUR_FRAME):
                grey = draw_grey_picture(cameras["color"], person.skin[2 * i])
                writers.write_picture(shot / f"color_image/{i:06d}.png", np.repeat(grey[..., None], 3, axis=2))


def write_event_hpe(root: Path) -> None:
    """Raw Event-HPE: events as .csv, grey pictures and SMPL poses of an action of six subjects."""
    import joblib

    width, height = event_hpe_files.RAW_SIZE
    f, c = event_hpe_files.FOCAL_LENGTH, event_hpe_files.CENTRE
    K = np.array([[f, 0, c - event_hpe_files.PADDING], [0, f, c], [0, 0, 1]])
    camera = Camera(K, np.eye(3), np.zeros(3), (width, height))
    turn = np.diag([1.0, -1.0, -1.0])
    for subject in EVENT_HPE_SUBJECTS:
        action = f"subject{subject:02d}_group1_time1"
        clip = move_person(subject, EVENT_HPE_FRAMES + 1, EVENT_HPE_RATE_HZ).clip
        person = person_of(move_world(clip, turn, np.array([0, 0.9, 3.6])))
        events = draw_events(camera, person, EVENT_HPE_FRAMES * EVENT_HPE_EVENTS, subject)
        frame = np.minimum(events.t * EVENT_HPE_RATE_HZ // 1_000_000, EVENT_HPE_FRAMES - 1)
        for i in range(EVENT_HPE_FRAMES + 1):
            joints3d = person.joints[i]
            small = project(camera, joints3d) + np.array([event_hpe_files.PADDING, 0])
            small *= event_hpe_files.POSE_IMAGE_SIZE / event_hpe_files.PADDED_SIZE
            pose = (
                person.clip.betas[None], person.clip.pose[i][None], person.clip.transl[i][None], joints3d,
                np.column_stack([small, joints3d[:, 2]]),
            )  # fmt: skip
            path = root / "pose_events" / action / f"pose{i:04d}.pkl"
            path.parent.mkdir(parents=True, exist_ok=True)
            joblib.dump(pose, path, compress=3)
            grey = draw_grey_picture(camera, person.skin[i])
            writers.write_picture(root / action / f"event_camera/full_pic/fullpic{i:04d}.jpg", grey)
            own = frame == i  # of the last, after the last pose, none; it is not read
            rows = np.stack(
                [height - 1 - events.y[own].astype(np.int64), width - 1 - events.x[own].astype(np.int64),
                 events.t[own], events.t[own] + 5, 2 * events.p[own].astype(np.int64) - 1], axis=1,
            )  # fmt: skip
            path = root / action / f"event_camera/events/event{i:04d}.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            columns = pa.table({str(column): rows[:, column] for column in range(5)})
            csv.write_csv(columns, path, csv.WriteOptions(include_header=False))


def write_n_imagenet(root: Path) -> None:
    """N-ImageNet: six classes, two of one name, with its lists and ImageNet's names."""
    dtype = [("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", np.bool_)]
    for kind, wordnet_id in enumerate(N_IMAGENET_NAMES):
        for folder, count in N_IMAGENET_PICTURES.items():
            for number in range(count):
                name = (
                    f"{wordnet_id}_{number}"
                    if folder == "extracted_train"
                    else f"ILSVRC2012_val_{kind:05d}{number:03d}"
                )
                path = root / folder / wordnet_id / f"{name}.npz"
                path.parent.mkdir(parents=True, exist_ok=True)
                columns = _shaken_outline(kind, n_imagenet.SENSOR_SIZE, THING_EVENTS, 100 * kind + number)
                events = np.empty(THING_EVENTS, dtype)
                for column, values in zip("txyp", columns, strict=True):
                    events[column] = values
                np.savez_compressed(path, event_data=events)
    writers.write_n_imagenet_lists(root)
    names = "".join(f"{wordnet_id} {names}\n" for wordnet_id, names in N_IMAGENET_NAMES.items())
    (root / "LOC_synset_mapping.txt").write_text(names)


def write_n_caltech101(root: Path) -> None:
    """N-Caltech101: the ten classes of the paper's Table 5."""
    for kind, name in enumerate(n_caltech101.ZERO_SHOT):
        for number in range(N_CALTECH101_PICTURES):
            seed = 1000 + 100 * kind + number
            columns = _shaken_outline(kind + 2, n_caltech101.FIELD, THING_EVENTS, seed)
            writers.write_atis(root / name / f"image_{number + 1:04d}.bin", *columns)


def write_amass(root: Path) -> None:
    """AMASS: motions of one sub-dataset, SMPL-H."""
    for number in range(AMASS_MOTIONS):
        clip = move_world(move_person(20 + number, AMASS_RATE_HZ, AMASS_RATE_HZ).clip, Y_UP_TO_Z_UP, np.zeros(3))
        poses = np.zeros((len(clip), 156))
        poses[:, :66] = clip.pose[:, :66]
        path = root / "CMU" / "01" / f"01_{number + 1:02d}_poses.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            path,
            poses=poses, trans=clip.transl, betas=np.zeros(16), mocap_framerate=np.array(float(AMASS_RATE_HZ)),
            gender=np.array("neutral"), dmpls=np.zeros((len(clip), 8)),
        )  # fmt: skip


def write_smpl(path: Path) -> None:
    """A body in SMPL's file: the bundled one, with corrective shapes of small random numbers."""
    import scipy.sparse

    with np.load(BUNDLED_BODY) as body:
        arrays: dict[str, Any] = {name: np.asarray(body[name]).astype(np.float64) for name in body.files}
    arrays["f"] = arrays["f"].astype(np.uint32)
    arrays["kintree_table"] = (arrays["kintree_table"].astype(np.int64) % 2**32).astype(np.uint32)
    arrays["posedirs"] = np.random.default_rng(0).normal(0, 1e-4, (len(arrays["v_template"]), 3, 207))
    regressor = scipy.sparse.csc_matrix(arrays["J_regressor"])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(writers.smpl_pickle({**arrays, "J_regressor": regressor}))


def _camera(focal_px: float, size: tuple[int, int], distance_m: float) -> Camera:
    """Upright, before somebody whose middle is 0.9 m above the ground."""
    K = np.array([[focal_px, 0, size[0] / 2], [0, focal_px, size[1] / 2], [0, 0, 1]])
    return Camera(K, np.diag([1.0, -1.0, -1.0]), np.array([0, 0.9, distance_m]), size)


def _shaken_outline(
    kind: int, size: tuple[int, int], count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Events t us, x, y, p [count] int64 of a star with `kind` + 3 rays that three saccades of 100 ms move."""
    random = np.random.default_rng([seed, 97])
    t = np.sort(random.integers(0, 300_000, count))
    angle = random.uniform(0, 2 * np.pi, count)
    radius = min(size) * random.uniform(0.3, 0.4) * (0.75 + 0.25 * np.cos((kind + 3) * angle))
    saccade, share = np.divmod(t, 100_000)
    direction = 2 * np.pi * saccade / 3
    shift = 0.03 * min(size) * (share / 100_000 - 0.5)
    x = size[0] / 2 + radius * np.cos(angle) + shift * np.cos(direction) + random.normal(0, 1, count)
    y = size[1] / 2 + radius * np.sin(angle) + shift * np.sin(direction) + random.normal(0, 1, count)
    p = (np.cos(angle - direction) + random.normal(0, 0.3, count) > 0).astype(np.int64)
    x, y = (np.clip(np.rint(v), 0, limit - 1).astype(np.int64) for v, limit in ((x, size[0]), (y, size[1])))
    return t, x, y, p
