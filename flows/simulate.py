"""A video, a folder of pictures or a still picture becomes events of a simulated camera: `ctlev simulate`."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ctlev_core import plugins
from ctlev_core.duration_text import duration_text
from ctlev_core.plugin_contracts import FormatWithWriter
from ctlev_core.plugins import PluginError
from data_contracts.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ctlev_core.video.frames import FrameOptions
    from ctlev_core.video.simulation import Interpolation
    from data_contracts.events import Events

SIGNAL_SUFFIX = ".signal.npy"
"""Of the file beside the events that says of each whether it is signal: [N] bool."""
LABELS_SUFFIX = ".labels.json"
"""Of the file beside the events that has the labels of the video, as COCO has them."""


@dataclass(frozen=True)
class SimulateOptions:
    """What a person asked of `ctlev simulate`; see its help."""

    sensor: str
    noise: float
    interpolation: Interpolation
    max_displacement_px: float
    seed: int
    format: str
    preview: Path | None
    overwrite: bool
    marks: bool = False
    labels: Path | None = None
    label_rate_hz: float | None = None


def simulate_file(source: Path, output: Path, frames: FrameOptions, options: SimulateOptions) -> int:
    """Write the events that a simulated camera sends while it watches a video, and say how many.

    Returns:
        Exit status: 0 written, 2 wrong input; then nothing is left at `output`.
    """
    started = time.perf_counter()
    try:
        name = find_writer(output, options.format)
        signal_file, labels_file, stale = _files_beside(source, output, name, options)
        from ctlev_core.events.files import write_event_chunks
        from ctlev_core.sensor.choice import read_sensor
        from ctlev_core.video.carried_labels import label_times, write_labels
        from ctlev_core.video.frames import open_frames
        from ctlev_core.video.label_files import read_video_labels
        from ctlev_core.video.preview import Preview, check_picture_suffix
        from ctlev_core.video.simulation import VideoSimulation, interpolator_of

        if options.preview is not None:
            check_picture_suffix(options.preview)
        simulation = VideoSimulation(
            open_frames(source, frames, options.max_displacement_px),
            read_sensor(options.sensor, options.noise),
            seed=options.seed,
            interpolator=interpolator_of(options.interpolation),
            max_displacement_px=options.max_displacement_px,
            marks=options.marks,
        )
        preview = Preview(simulation) if options.preview is not None else None
        labels = read_video_labels(options.labels, simulation.frames) if options.labels is not None else None
        label_times([0], options.label_rate_hz)  # refused before the work starts
        chunks: Iterable[Events] = simulation if preview is None else preview.watch()
        signal: list[np.ndarray] = []
        with _written_whole(filter(None, (output, signal_file, labels_file))) as partial:
            write_event_chunks(partial[output], chunks if signal_file is None else _watch_signal(chunks, signal), name)
            if signal_file is not None:
                np.save(partial[signal_file], np.concatenate(signal))
            if labels_file is not None and labels is not None and simulation.size is not None:
                seen = simulation.frames, simulation.size
                write_labels(partial[labels_file], labels, *seen, output.name, options.label_rate_hz)
        for path in stale:
            path.unlink()
        if preview is not None and options.preview is not None:
            preview.write(options.preview)
    except (DataError, PluginError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    assert simulation.size is not None
    width, height = simulation.size
    rate = simulation.num_events / max(simulation.duration_us, 1)
    skipped = simulation.frames.num_skipped
    print(
        f"{simulation.num_events} events of {width} x {height} px in {simulation.duration_us / 1e6:.3f} s "
        f"({rate:.3g} million a second), from {simulation.num_frames} frames, {simulation.num_drawn} drawn"
        + (f"; {skipped} frames not after the one before were left out" if skipped else "")
    )
    written = {"events": output, "signal or noise": signal_file, "labels": labels_file, "preview": options.preview}
    print("\n".join(f"{what}: {path}" for what, path in written.items() if path is not None))
    print(f"in {duration_text(time.perf_counter() - started)}")
    return 0


def find_writer(output: Path, name: str = "") -> str:
    """The name of the format to write, as asked for or by the suffix of the file.

    Raises:
        PluginError: no such format, or none with that suffix.
    """
    writers = {}
    for one in [name] if name else plugins.names("formats"):
        module = plugins.load("formats", one)
        if isinstance(module, FormatWithWriter):
            writers[one] = module
    if name:
        if not writers:
            raise PluginError(f"format {name!r} is read only")
        return name
    suffix = output.suffix.lower()
    found = [one for one, module in writers.items() if suffix in module.SUFFIXES]
    if not found:
        known = ", ".join(f"{one} ({', '.join(module.SUFFIXES)})" for one, module in writers.items())
        raise PluginError(f"{output}: no format is written with the suffix {suffix!r}; known: {known}")
    # Formats that share a suffix: the newest of them, which comes last by name (.raw is EVT3).
    return found[-1]


@contextmanager
def _written_whole(paths: Iterable[Path]) -> Iterator[dict[Path, Path]]:
    """Other names to write files under, by path; they get their own when all are complete. Errors name their own."""
    partial = {path: path.with_name(f".partial-{path.name}") for path in paths}
    try:
        yield partial
        for path, unfinished in partial.items():
            unfinished.replace(path)
    except (DataError, OSError) as error:
        message = str(error)
        for path, unfinished in partial.items():
            message = message.replace(str(unfinished), str(path))
        raise DataError(message) from None
    finally:
        for unfinished in partial.values():
            unfinished.unlink(missing_ok=True)


def _watch_signal(chunks: Iterable[Events], signal: list[np.ndarray]) -> Iterator[Events]:
    """Hand the chunks on, their marks gathered."""
    for chunk in chunks:
        assert chunk.signal is not None
        signal.append(chunk.signal)
        yield chunk


def _files_beside(
    source: Path, output: Path, name: str, options: SimulateOptions
) -> tuple[Path | None, Path | None, list[Path]]:
    """The files of marks and of labels, None where none is written, and those there that are of earlier events.

    Raises:
        DataError: a file that is written, or goes, is there already, or is what is read.
        ValueError: a rate of labels, and no labels.
    """
    signal_file = labels_file = None
    if options.marks and not getattr(plugins.load("formats", name), "HOLDS_SIGNAL", False):
        signal_file = output.with_suffix(SIGNAL_SUFFIX)
    if options.labels is not None:
        labels_file = output.with_suffix(LABELS_SUFFIX)
    elif options.label_rate_hz is not None:
        raise ValueError("--label-rate is of labels, and none are given: name their file with --labels")
    read = [given for given in (source, options.labels) if given is not None and given.exists()]
    for path in filter(None, (output, options.preview, signal_file, labels_file)):
        _check_free(path, overwrite=options.overwrite)
        if path.exists() and any(path.samefile(given) for given in read):
            raise DataError(f"{path}: is what is read; choose another name to write to")
    beside = [output.with_suffix(suffix) for suffix in (SIGNAL_SUFFIX, LABELS_SUFFIX)]
    stale = [path for path in beside if path.is_file() and path not in (signal_file, labels_file)]
    stale = [path for path in stale if not any(path.samefile(given) for given in read)]
    for path in stale:
        _check_free(path, overwrite=options.overwrite)
    return signal_file, labels_file, stale


def _check_free(path: Path, *, overwrite: bool) -> None:
    if not path.absolute().parent.is_dir():
        raise DataError(f"{path}: there is no folder {path.absolute().parent}")
    if path.exists() and not overwrite:
        raise DataError(f"{path}: is there already; --overwrite replaces it")
    if path.is_dir():
        raise DataError(f"{path}: is a folder")
