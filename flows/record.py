"""Simulated recordings of people with labels of every pixel and event: `ctlev record`."""

from __future__ import annotations

import contextlib
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ctlev_core.datasets import studio
from ctlev_core.duration_text import duration_text
from ctlev_core.plugins import PluginError, validate_options
from ctlev_core.progress import ProgressBar
from ctlev_core.studio.labelled_recordings import EVENT_LABELS_FILE, LABELS_FILE, CocoTable, write_labelled
from data_contracts.claimed_folders import folder_claimed
from data_contracts.errors import DataError
from flows.command_line import apply_override
from flows.simulate import find_writer

COUNTS = {split: f"num_{split}_recordings" for split in studio.SPLIT_NAMES}


def record_people(
    folder: Path,
    count: int,
    overrides: Sequence[str] = (),
    *,
    split: str = "condition",
    rate_hz: float = 100.0,
    suffix: str = ".parquet",
    overwrite: bool = False,
) -> int:
    """Write recordings of the studio with their labels, and say what there is.

    Args:
        folder: is made, complete or not at all.
        count: recordings.
        overrides: options of the studio, `name=value`.
        split: whose people and motions: a key of `COUNTS`.
        rate_hz: labelled moments a second.
        suffix: of the files of events, which says their format.
        overwrite: replace a folder that is there, if it holds recordings of this command.
    Returns:
        Exit status: 0 written, 2 wrong input, 130 interrupted.
    """
    # `new/..` is not there until `new` is made, and is then the folder around it.
    started, folder = time.perf_counter(), folder.resolve()
    partial = folder.parent / f".partial-{folder.name}"
    try:
        options = _options(count, overrides, split, rate_hz)
        format_name = find_writer(Path(f"events{suffix}"))
        recordings, table, num_events = studio.list_recordings(options), CocoTable(options.joint_set), 0
        with _claimed(partial, folder):
            _check_free(folder, overwrite=overwrite)
            for recording in ProgressBar(recordings, desc="recordings", unit="recording"):
                place = partial / recording.recording_id.replace("/", "_")
                num_events += write_labelled(
                    place, recording, options, suffix=suffix, format_name=format_name, table=table
                )
            table.write(partial / LABELS_FILE)
            _check_free(folder, overwrite=overwrite)  # of what came meanwhile nobody asked that it goes
            if folder.exists():
                shutil.rmtree(folder)
            partial.rename(folder)
    except (DataError, PluginError, ValueError, OSError) as error:
        print(f"error: {str(error).replace(str(partial), str(folder))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        return 130
    width, height = options.sensor_size
    print(
        f"{len(recordings)} recordings of {width} x {height} px and {1e-6 * options.recording_duration_us:g} s, "
        f"{num_events:,} events, labels {rate_hz:g} times a second: {folder}"
    )
    print(f"in {duration_text(time.perf_counter() - started)}")
    return 0


@contextlib.contextmanager
def _claimed(partial: Path, folder: Path) -> Iterator[None]:
    """Inside this block `partial` is this process's alone, empty at first, and removed where the block fails."""
    with folder_claimed(partial, f"{folder}: another process is recording into this folder"):
        try:
            for left in partial.iterdir():  # by a process that was killed
                shutil.rmtree(left) if left.is_dir() else left.unlink()
            yield
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise


def _check_free(folder: Path, *, overwrite: bool) -> None:
    """Raise where recordings would take the place of what nobody asked to replace, or of what is none of ours."""
    if not folder.exists():
        return
    if not overwrite:
        raise DataError(f"{folder}: is there already; --overwrite replaces it")
    if not (folder / LABELS_FILE).is_file() or not list(folder.glob(f"*/{EVENT_LABELS_FILE}")):
        raise DataError(f"{folder}: --overwrite replaces folders that `ctlev record` made, and this is none")


def _options(count: int, overrides: Sequence[str], split: str, rate_hz: float) -> studio.Options:
    values: dict[str, Any] = {}
    for override in overrides:
        apply_override(values, override)
    fixed = {name: count if name == COUNTS[split] else 0 for name in COUNTS.values()}
    fixed |= {"label_rate_hz": rate_hz, "record_conditions": split == "condition"}
    if wrong := sorted(values.keys() & fixed.keys()):
        raise PluginError(f"--set {wrong[0]}: is given by the number of recordings, --split and --rate")
    return validate_options(studio.Options, values | fixed, "studio")
