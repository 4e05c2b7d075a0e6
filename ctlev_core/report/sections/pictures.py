"""Pictures of the report made from manifests: what was done in four of them, grids, and frames in motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ctlev_core.events.windows import spread
from ctlev_core.labels.source_moments import source_moment
from ctlev_core.report.page.display_names import set_name
from ctlev_core.report.page.html import Animation, Colours, ImageGrid, Step
from data_contracts.manifest import Manifest

GRID_COLUMNS = 10
FEWEST_MOVING = 8
"""Frames in the order of time that are worth an animation."""
MAX_CLIPS = 6
MAX_CANDIDATES = 200
"""Frames among which the one of median activity is looked for."""
_KINDS = {
    "skeleton": "a skeleton: where the joints of a body are",
    "normals": "a body: which way each part of its surface faces",
    "body_motion": "a body that moves",
    "intensity_pair": "two ordinary pictures, one after the other",
}


def condition_in_words(kind: str) -> str:
    """What a condition of this plug-in is."""
    return _KINDS.get(kind, "words, as the generator reads them" if kind == "text" else f"a condition, `{kind}`")


def steps(frames: Manifest, frame_conditions: Manifest, conditions: Manifest, made: Manifest, kind: str) -> list[Step]:
    """What was done, in four pictures: a recorded label and its event image, a new label and its synthetic one.

    Frames are those of median activity (active pixels), not chosen by eye.

    Args:
        frames: recorded ones.
        frame_conditions: what they were learnt with.
        conditions: what was asked for.
        made: the synthetic frames, row by row those of `conditions`.
        kind: name of the condition plug-in.
    """
    rows = {name: row for row, name in enumerate(frames.column("sample_id"))}
    learnt = np.array([rows[name] for name in frame_conditions.column("sample_id")], np.int64)
    if not len(learnt) or not len(made):
        return []
    first = _of_median_activity(frames, learnt)
    second = _of_median_activity(made, np.arange(len(made)))
    asked = {name: row for row, name in enumerate(conditions.column("sample_id"))}
    real, fake = np.asarray(frames.array("frames")[learnt[first]]), np.asarray(made.array("frames")[second])
    t_start_us, t_end_us = (frames.column(name)[learnt[first]] for name in ("t_start_us", "t_end_us"))
    colours = colours_in_words(real)
    return [
        Step(
            "1. A label",
            _condition(frame_conditions, first),
            f"What is known of a recorded moment, {condition_in_words(kind)}.",
        ),
        Step(
            "2. A recorded event image",
            real,
            "The camera takes no pictures: each pixel reports when its brightness changes. These are the reports, "
            f"events, of {(t_end_us - t_start_us) / 1000:.3g} ms, {colours}.",
            follows=True,
        ),
        Step(
            "3. A new label",
            _condition(conditions, asked[made.column("condition_id")[second]]),
            "Another one: no event image of it need exist.",
        ),
        Step(
            "4. A synthetic event image",
            fake,
            "Made for it by a generator that learnt from pairs like the first. Its label is known, so that other "
            "models can be trained on it.",
            follows=True,
        ),
    ]


def colours_in_words(image: np.ndarray) -> str:
    """How the colours of an event image [H, W, 3] read: green is drawn by `time_bins` alone."""
    if (image == image[..., :1]).all():
        return "white where there were any"
    return "a colour for each part of that time" if image[..., 1].any() else "red where it got brighter, else blue"


def _condition(conditions: Manifest, row: int) -> np.ndarray | str:
    if conditions.has_array("images"):
        return np.asarray(conditions.array("images")[row])
    return f"“{conditions.column('prompt')[row]}”"


def _of_median_activity(manifest: Manifest, rows: np.ndarray) -> int:
    """Index into `rows` of the frame whose number of active pixels is the median one."""
    candidates = spread(len(rows), MAX_CANDIDATES)
    frames = manifest.array("frames")
    active = [np.count_nonzero(np.asarray(frames[row]).any(axis=-1)) for row in rows[candidates]]
    return int(candidates[np.argsort(active, kind="stable")[(len(active) - 1) // 2]])


def sample_grids(
    conditions: Manifest, generated: Mapping[str, Manifest], real: list[Manifest], colours: Colours = ()
) -> list[ImageGrid]:
    """The grid of `sample_grid`, and one of frames alone for each generator that was asked for other labels."""
    first = next(iter(generated.values())).column("source_id")
    same, others = {}, []
    for name, frames in generated.items():
        if frames.column("source_id") == first:
            same[name] = frames
            continue
        names = frames.column("class_name")
        chosen = evenly_by_class(names, GRID_COLUMNS)
        row = (set_name(name), [np.asarray(frames.array("frames")[index]) for index in chosen])
        caption = "It was asked for other labels than the others. One column a sample, none chosen by eye."
        labels = [names[index] for index in chosen]
        others.append(ImageGrid(f"Sampled: {set_name(name)}", [row], column_labels=labels, caption=caption))
    return [sample_grid(conditions, same, real, colours), *others]


def sample_grid(
    conditions: Manifest, generated: Mapping[str, Manifest], real: list[Manifest], colours: Colours = ()
) -> ImageGrid:
    """Condition, recorded frame of the same moment or at least class where there is one, and the frame of each
    generator.

    Args:
        conditions: what was asked for.
        generated: frames by generator; all were asked for the same.
        real: sets of recorded frames to look for the same moments in.
        colours: legend.
    """
    synthetic = next(iter(generated.values()))
    matches = _same_moments(synthetic.column("source_id"), real)
    matched = np.flatnonzero([match is not None for match in matches])
    rows_of = matched if len(matched) >= GRID_COLUMNS else np.arange(len(synthetic))
    names = synthetic.column("class_name")
    chosen = rows_of[evenly_by_class([names[row] for row in rows_of], GRID_COLUMNS)]
    rows: list[tuple[str, list[np.ndarray]]] = []
    if conditions.has_array("images"):
        asked = {name: row for row, name in enumerate(conditions.column("sample_id"))}
        members = [asked[synthetic.column("condition_id")[row]] for row in chosen]
        rows.append(("condition", [np.asarray(conditions.array("images")[row]) for row in members]))
    found = [matches[row] for row in chosen]
    caption = "One column a sample, evenly spread, none chosen by eye."
    if any(match is not None for match in found):
        blank = np.full_like(synthetic.array("frames")[0], 128)
        caption += " Grey: no recorded frame shows that moment." if any(match is None for match in found) else ""
        rows.append(("recorded, same moment", [blank if match is None else match for match in found]))
    elif not conditions.has_array("images"):
        rows += _same_classes([names[row] for row in chosen], real)
    for name, frames in generated.items():
        rows.append((set_name(name), [np.asarray(frames.array("frames")[row]) for row in chosen if row < len(frames)]))
    labels = [names[row] for row in chosen]
    return ImageGrid("Asked for, and sampled", rows, column_labels=labels, caption=caption, colours=colours)


def evenly_by_class(class_names: Sequence[str], count: int) -> np.ndarray:
    """Indices of at most `count` rows, evenly spread over the classes and over the rows of each.

    Classes take turns in what is sampled, so that rows a fixed number apart may all be of one class.
    """
    if len(class_names) <= count:
        return np.arange(len(class_names))
    members: dict[str, list[int]] = {}
    for row, name in enumerate(class_names):
        members.setdefault(name, []).append(row)
    classes = [list(members)[index] for index in np.resize(spread(len(members), count), count)]
    columns = [members[name][column * len(members[name]) // count] for column, name in enumerate(sorted(classes))]
    return np.array(sorted(set(columns)), np.int64)


def _same_classes(class_names: Sequence[str], real: list[Manifest]) -> list[tuple[str, list[np.ndarray]]]:
    """A row of recorded test frames of these classes, the later set of frames first; none where there are no such."""
    shown: dict[str, list[np.ndarray]] = {name: [] for name in class_names}
    for manifest in reversed(real):
        names = manifest.column("class_name")
        for row in manifest.rows_where(split=manifest.held_out):
            if names[row] in shown and len(shown[names[row]]) < GRID_COLUMNS:
                shown[names[row]].append(np.asarray(manifest.array("frames")[row]))
    if not all(shown.values()):
        return []
    taken = [list(class_names[:column]).count(name) for column, name in enumerate(class_names)]
    return [
        (
            "recorded, same class",
            [shown[name][n % len(shown[name])] for n, name in zip(taken, class_names, strict=True)],
        )
    ]


def _same_moments(source_ids: list[str], real: list[Manifest]) -> list[np.ndarray | None]:
    """For each `RECORDING:TIME`, or name of a frame, the recorded frame of it; None where there is none."""
    found: list[np.ndarray | None] = [None] * len(source_ids)
    for manifest in real:
        names = {name: row for row, name in enumerate(manifest.column("sample_id"))}
        members: dict[str, list[int]] = {}
        for row, name in enumerate(manifest.column("recording_id")):
            members.setdefault(name, []).append(row)
        starts, ends = (np.array(manifest.column(name), np.int64) for name in ("t_start_us", "t_end_us"))
        for index, source_id in enumerate(source_ids):
            name, t_us = source_moment(source_id)
            row = names.get(source_id)
            if row is None and t_us >= 0:
                around = [r for r in members.get(name, ()) if starts[r] <= t_us <= ends[r]]
                row = min(around, key=lambda r: abs(starts[r] + ends[r] - 2 * t_us), default=None)
            if row is not None and found[index] is None:
                found[index] = np.asarray(manifest.array("frames")[row])
    return found


def real_grid(frames: Manifest, target: Manifest | None = None) -> ImageGrid:
    """Some recorded training and held-out frames, evenly spread; `target` are those of another dataset tested on."""
    rows: list[tuple[str, list[np.ndarray]]] = []
    sets = [("recorded", frames, ("train", frames.held_out))]
    if target is not None:
        sets = [("the generator's", frames, ("train",)), ("recorded", target, ("train", target.held_out))]
    for name, manifest, splits in sets:
        for split in splits:
            members = manifest.rows_where(split=split)
            chosen = members[spread(len(members), GRID_COLUMNS)]
            rows.append((f"{name}, {split}", [np.asarray(manifest.array("frames")[row]) for row in chosen]))
    return ImageGrid("Recorded frames", rows, caption="The data the generator was tuned on, and the data tested on.")


def motion(conditions: Manifest, synthetic: Manifest) -> list[Animation]:
    """Conditions beside the frames sampled for them, as they follow in time, where they do."""
    if not conditions.has_array("images"):
        return []
    found = [run for run in runs(synthetic.column("source_id")) if len(run[1]) >= FEWEST_MOVING][:MAX_CLIPS]
    if not found:
        return []
    clips = []
    for _, rows, _ in found:
        pictures = [np.asarray(array[rows]) for array in (conditions.array("images"), synthetic.array("frames"))]
        clips.append((synthetic.column("class_name")[rows[0]], np.concatenate(pictures, axis=2)))
    step_us = float(np.median([step for _, _, step in found]))
    caption = "Left the condition, right the frame sampled for it; every frame is sampled on its own."
    return [Animation("In motion", clips, 1e6 / step_us, caption)]


def runs(source_ids: list[str]) -> list[tuple[str, np.ndarray, float]]:
    """Rows that follow one another in the time of one recording: its name, the rows, the median step in us."""
    found: list[tuple[str, list[int], list[int]]] = []
    for row, source_id in enumerate(source_ids):
        name, t_us = source_moment(source_id)
        if found and found[-1][0] == name and 0 <= found[-1][2][-1] < t_us:
            found[-1][1].append(row)
            found[-1][2].append(t_us)
        else:
            found.append((name, [row], [t_us]))
    return [(name, np.array(rows), float(np.median(np.diff(times)))) for name, rows, times in found if len(rows) > 1]
