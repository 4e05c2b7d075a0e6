"""Motions told in words; poses to sample from, without events: sentence to motion to condition to event frames.

Each sentence is performed so many times, by the project's own small generator
(`ctlev_core.body.text_to_motion.compose`), which knows a few dozen verbs and refuses sentences that it does not
understand. Motions that a learned model such as MDM made elsewhere take its place with the option `results`: a file
that it wrote, or a folder of such files, in any format of `ctlev_core/motions`. What they show is in the files (MDM's
`results.npy` has the sentences), or in a text file of the same name beside them (HumanML3D: a line a caption, what
follows `#` is not read), or else the file's name.

The class of a recording is its sentence. The camera is a virtual one (`ctlev_core.dataset_files.pose_sources`).

Source: ControlEvents, section 3.4: text to motion to normal maps to events, with UniMotion and MDM.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from pydantic import Field

from ctlev_core import plugins
from ctlev_core.body.motion import files as motion_formats
from ctlev_core.body.motion.clip import MotionClip
from ctlev_core.dataset_files.pose_sources import PoseSourceOptions
from ctlev_core.dataset_files.pose_sources import labels_before_camera as _labels_before_camera
from ctlev_core.dataset_files.trees import check_inside, list_folder
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording

VERSION = 3

EXAMPLES = (
    "a person walks, then jumps twice",
    "someone runs in a circle and then waves with the left hand",
    "a man walks slowly to the left, turns around and sits down",
    "a woman claps, bows and walks backward",
    "a person kicks twice with the right leg, then punches",
    "a person walks while waving with the right hand",
    "someone picks up a box, turns right and walks for 2 seconds",
    "a person marches in place, then does three jumping jacks",
)
MAX_VARIATIONS = 1000
_MAX_NAME = 60
_NOT_IN_IDS = re.compile(r"[^a-z0-9]+")
_MOTIONS_ALONE = (".npy", ".npz", ".bvh", ".pkl")
"""Suffixes that in a folder of results belong to motions and nothing else."""


class Options(PoseSourceOptions):
    """Options of motions told in words."""

    sentences: tuple[str, ...] = Field(
        default=(),
        description="what is performed; with `results`, only motions with these captions. Empty = examples, or all "
        "results",
    )
    variations: int = Field(
        default=1, ge=1, le=MAX_VARIATIONS, description="performances of each sentence; without `results`"
    )
    results: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="a file, or a folder of files, of motions that another text-to-motion model made",
    )
    results_rate_hz: float | None = Field(
        default=None, gt=0, description="frames a second of results that do not say; None = their format's"
    )


def list_recordings(options: Options) -> list[Recording]:
    """One recording a sentence and performance, or one a motion of `results`; label-only, of the split `condition`.

    The id is the sentence in letters, digits and `_`, shortened, and the number of the performance.

    Raises:
        DataError: a sentence that is not understood or comes twice; no such results, a file among them that is damaged,
            or none with a sentence that is asked for.
    """
    if options.results is not None:
        return _list_results(options.results, options)
    from ctlev_core.body.text_to_motion.compose import check_sentence

    sentences = [_one_line(sentence) for sentence in options.sentences or EXAMPLES]
    for sentence in sentences:
        check_sentence(sentence)
    return [
        Recording(f"{name}/{number}", f"{name}/{number}", (Part("condition"),), sentence, has_events=False)
        for name, sentence in zip(_names(sentences), sentences, strict=True)
        for number in range(options.variations)
    ]


def read_events(recording: Recording, options: Options) -> Events:
    """There are none.

    Raises:
        DataError: always.
    """
    raise DataError(f"text_motion {recording.recording_id}: a pose source has no events")


def read_labels(recording: Recording, options: Options) -> Labels:
    """SMPL labels of the chosen moments, in the frame of the recording's virtual camera.

    Raises:
        DataError: see `ctlev_core.body.text_to_motion.compose.generate_motion`, or the `read` of the results' format.
    """
    number = int(recording.recording_id.rpartition("/")[2])
    if recording.files:
        clip = _read_results(recording.files[0], options)[number]
    else:
        from ctlev_core.body.text_to_motion.compose import generate_motion

        clip = generate_motion(recording.class_name, seed=MAX_VARIATIONS * options.seed + number)
    return _labels_before_camera(clip, recording.class_name, recording.recording_id, options)


def _list_results(results: Path, options: Options) -> list[Recording]:
    files = _result_files(results)
    stems = [file.stem for file in files]
    wanted = {_one_line(sentence) for sentence in options.sentences}
    recordings, found = [], set()
    for file, name in zip(files, _names(stems), strict=True):
        for number, clip in enumerate(_read_results(file, options)):
            found.add(clip.caption)
            if not wanted or clip.caption in wanted:
                recording_id = f"{name}/{number}"
                parts = (Part("condition"),)
                recordings.append(
                    Recording(recording_id, recording_id, parts, clip.caption, has_events=False, files=(file,))
                )
    missing = sorted(wanted - found)
    if missing:
        raise DataError(f"{results}: no motion of the sentence {missing[0]!r}; there are: {'; '.join(sorted(found))}")
    return recordings


def _result_files(results: Path) -> list[Path]:
    """The motion files of a folder, sorted, or the one file."""
    if results.is_file():
        return [results]
    if not results.is_dir():
        raise DataError(f"{results}: no such file or folder")
    files = []
    for file in list_folder(results):
        if file.is_dir():
            continue
        check_inside(file, results)
        if motion_formats.find_format(file) is not None:
            files.append(file)
        elif file.suffix.lower() in _MOTIONS_ALONE:
            motion_formats.read_motion(file)  # raises
    if not files:
        known = ", ".join(motion_formats.list_formats())
        raise DataError(f"{results}: expected motion files of the formats {known}, found none")
    return files


def _read_results(file: Path, options: Options) -> list[MotionClip]:
    """Every motion of a file, each with a caption."""
    joints = plugins.load("motions", "joints_npy")
    if motion_formats.find_format(file) is joints:
        clips = joints.read_all(file, options.results_rate_hz or joints.RATE_HZ)
    else:
        clips = [motion_formats.read_motion(file, options.results_rate_hz)]
    return [replace(clip, caption=_one_line(clip.caption) or _caption_beside(file)) for clip in clips]


def _caption_beside(file: Path) -> str:
    text = file.with_suffix(".txt")
    if text == file or not text.is_file():
        return file.stem
    try:
        lines = text.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{text}: cannot be read as a caption: {error}") from error
    return _one_line(lines[0].partition("#")[0] if lines else "") or file.stem


def _one_line(sentence: str) -> str:
    return " ".join(sentence.split()).rstrip(".")


def _names(texts: Iterable[str]) -> list[str]:
    """Names for recording ids, all different."""
    owners: dict[str, str] = {}
    for text in texts:
        name = _NOT_IN_IDS.sub("_", text.lower()).strip("_") or "motion"
        if len(name) > _MAX_NAME:
            name = f"{name[: _MAX_NAME - 9].rstrip('_')}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
        if name in owners:
            raise DataError(f"{owners[name]!r} and {text!r} would get the same recording id {name!r}; change one")
        owners[name] = text
    return list(owners)
