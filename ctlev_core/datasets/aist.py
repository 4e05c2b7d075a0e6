"""AIST++: 3D dance motion as SMPL sequences, 60 frames a second; poses to sample from, without events.

Root and layout as published (the folder of annotations):

    aist_plusplus_final/
      motions/
        gBR_sBM_cAll_d04_mBR0_ch01.pkl      (smpl_poses [T, 72], smpl_trans [T, 3], smpl_scaling [1], smpl_loss)
      ignore_list.txt                       (motions whose reconstruction is bad; left out)

The files are read by the motion format `aist`, which runs nothing that such a pickle may carry.

A motion's name says genre, situation, camera, dancer, music and choreography: the class is the genre, the subject the
dancer. The moments are seen by a virtual camera (`ctlev_core.dataset_files.pose_sources`), not by one of AIST's nine.

Source: Li et al., AI Choreographer (AIST++), ICCV 2021 (google.github.io/aistplusplus_dataset;
github.com/google/aistplusplus_api `aist_plusplus/loader.py`, `demos/extract_motion_feats.py`); Tsuchida et al., AIST
Dance Video Database, ISMIR 2019 (genres); ControlEvents, section 3.4: poses from AIST to sample from.
"""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import Field

from ctlev_core import plugins
from ctlev_core.dataset_files.pose_sources import PoseSourceOptions
from ctlev_core.dataset_files.pose_sources import labels_before_camera as _labels_before_camera
from ctlev_core.dataset_files.trees import check_root, list_files, read_lines
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording

VERSION = 2

GENRES = {
    "BR": "break",
    "PO": "pop",
    "LO": "lock",
    "MH": "middle hip-hop",
    "LH": "LA-style hip-hop",
    "HO": "house",
    "WA": "waack",
    "KR": "krump",
    "JS": "street jazz",
    "JB": "ballet jazz",
}
_NAME = re.compile(r"g(?P<genre>[A-Z]{2})_s[A-Z]{2}_cAll_(?P<dancer>d\d{2})_m[A-Z]{2}\d_ch\d{2}")

EXPECTED_TREE = """expected the unpacked annotations of AIST++ (fullset.zip, or motions.zip and ignore_list.txt):
  ROOT/
    motions/
      gBR_sBM_cAll_d04_mBR0_ch01.pkl
    ignore_list.txt"""


class Options(PoseSourceOptions):
    """Options of AIST++."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder that holds the folder `motions`")
    genres: tuple[str, ...] = Field(default=(), description="only these, such as `break`; empty = all ten")
    with_ignored: bool = Field(default=False, description="with the motions of ignore_list.txt, which are bad")


def list_recordings(options: Options) -> list[Recording]:
    """Every motion, sorted by name; label-only recordings of the split `condition`.

    Raises:
        DataError: the tree is not as expected (the message says where and shows it), a name that is no motion's, or
            nothing is left.
    """
    root = check_root(options.root, EXPECTED_TREE, lambda folder: (folder / "motions").is_dir())
    unknown = [genre for genre in options.genres if genre not in GENRES.values()]
    if unknown:
        raise DataError(f"{root}: no genre {unknown[0]!r}; there are: {', '.join(GENRES.values())}")
    ignored = set() if options.with_ignored else _read_ignored(root)
    recordings = []
    for file in list_files(root / "motions", root, ".pkl"):
        match = _NAME.fullmatch(file.stem)
        if match is None or match["genre"] not in GENRES:
            raise DataError(f"{file}: expected a name such as gBR_sBM_cAll_d04_mBR0_ch01, got {file.stem!r}")
        genre = GENRES[match["genre"]]
        if file.stem not in ignored and (not options.genres or genre in options.genres):
            parts = (Part("condition"),)
            recordings.append(Recording(file.stem, match["dancer"], parts, genre, has_events=False, files=(file,)))
    if not recordings:
        raise DataError(f"{root}: no motion is left with these options")
    return recordings


def read_events(recording: Recording, options: Options) -> Events:
    """There are none.

    Raises:
        DataError: always.
    """
    raise DataError(f"aist {recording.recording_id}: a pose source has no events")


def read_labels(recording: Recording, options: Options) -> Labels:
    """SMPL labels of the chosen moments, in the frame of the recording's virtual camera.

    Raises:
        DataError: the file cannot be read, holds code, lacks a key, has other shapes, no frames, or numbers that are
            not finite.
    """
    clip = plugins.load("motions", "aist").read(recording.files[0])
    return _labels_before_camera(clip, recording.class_name, recording.recording_id, options)


def _read_ignored(root: Path) -> set[str]:
    file = root / "ignore_list.txt"
    if not file.is_file():
        raise DataError(
            f"{file}: no such file; without it bad motions would be taken (or set with_ignored); {EXPECTED_TREE}"
        )
    return {name for _, name in read_lines(file)}
