"""`ctlev simulate` beside the published algorithm of v2e: the same frames, the same thresholds.

    python benchmarks/video_beside_v2e.py [--video FILE] [--size 346x260] [--every 10]

One table, a row for each way of getting from frames to events:

    time    of the video with all its frames, s of one core a second of video; the sensor has mismatch, low-pass,
            refractory time, leak and shot noise (`dvs346` without hot pixels, which v2e has not)
    rate    million events a second, and the share of them that is ON, in that simulation
    scene   a textured scene in closed form that moves at 446 px a second, filmed at 60 frames a second, beside its
            events at 8,000 frames a second: share of those that have one of the same pixel and polarity within 1 ms,
            the median time to the nearest, and how many events there are for each of the reference
    video   the same of the video, of which every tenth frame is given and all are the reference, within 10 ms; between
            the frames of the reference light is a line, as neither interpolator has it. Both with an ideal sensor

v2e is its published algorithm (Hu et al., v2e: From video frames to realistic DVS events, CVPRW 2021), see
`sensor.simulate_v2e`. Its interpolator is a network, Super SloMo, whose weights are not here: `frames as given` leaves
it out (v2e's --disable_slomo), `drawn by flow` shows its pixels the frames that our flow draws for ours.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from sensor import simulate_v2e
from video import SceneFrames

from ctlev_core.events.decoding.event_tables import parse_sensor_size
from ctlev_core.sensor.dvs_pixel import PRESETS, Sensor, join, simulate_events
from ctlev_core.sensor.options import SensorOptions, sample_pixel_maps
from ctlev_core.video.frames import FrameOptions, Frames, open_frames
from ctlev_core.video.interpolation import Fading, Flow, num_steps
from ctlev_core.video.simulation import MAX_STEPS, VideoSimulation
from data_contracts.events import Events

VIDEO = Path(__file__).resolve().parents[2] / "shared" / "real" / "video" / "single" / "cam02.mp4"
NOISY = PRESETS["dvs346"].model_copy(update={"hot_pixel_fraction": 0.0})
ROUNDS = 3


class EveryNth(Frames):
    """Some of the frames of a video."""

    def __init__(self, frames: Frames, every: int) -> None:
        self._frames, self._every = frames, every

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        for number, frame in enumerate(self._frames):
            if number % self._every == 0:
                yield frame


def ours(frames: Frames, options: SensorOptions, interpolator: Callable[[], Flow | Fading]) -> Events:
    """As `ctlev simulate`."""
    simulation = VideoSimulation(frames, options, interpolator=interpolator())
    chunks = list(simulation)
    assert simulation.size is not None
    return join(chunks, simulation.size)


def v2e(frames: Frames, options: SensorOptions, flow: Flow | None) -> Events:
    """The published algorithm, on the frames or on those that flow draws between them."""
    times, pictures = zip(*(frames if flow is None else drawn(frames, flow)), strict=True)
    size = pictures[0].shape[1], pictures[0].shape[0]
    maps = sample_pixel_maps(size, options, 0)
    rows = simulate_v2e(np.stack(pictures), np.array(times, np.int64), options, maps, np.random.default_rng(0))
    t, x, y, p = (rows[:, k] for k in range(4))
    kinds = np.int64, np.uint16, np.uint16, np.uint8
    columns = [column.astype(kind) for column, kind in zip((np.rint(1e6 * t), x, y, p), kinds, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    return Events(*(column[order] for column in columns), size)


def drawn(frames: Frames, flow: Flow) -> Iterator[tuple[int, np.ndarray]]:
    """Whole frames as densely as things move, with those between drawn by flow."""
    last: tuple[int, np.ndarray] | None = None
    for t_us, light in frames:
        if last is not None:
            before_us, before = last
            between = flow.between(before, light)
            steps = num_steps(between.displacement_px, 1.0, min(MAX_STEPS, t_us - before_us))
            for share in (np.arange(1, steps) / steps).tolist():
                frame = ((1 - share) * before + share * light).astype(np.float32)
                frame.reshape(-1)[between.moving] = between.at(share)
                yield before_us + round(share * (t_us - before_us)), frame
        yield t_us, light
        last = t_us, light


WAYS: dict[str, Callable[[Frames, SensorOptions], Events]] = {
    "ours, flow (default)": lambda frames, options: ours(frames, options, Flow),
    "ours, fade": lambda frames, options: ours(frames, options, Fading),
    "v2e, frames as given": lambda frames, options: v2e(frames, options, None),
    "v2e, drawn by flow": lambda frames, options: v2e(frames, options, Flow()),
}


def compare(events: Events, reference: Events, within_us: int) -> tuple[float, float, float]:
    """Share of the reference found within that time, median time to the nearest in ms, events for each of it."""

    def line(one: Events) -> np.ndarray:
        width, height = one.sensor_size
        pixel = one.y.astype(np.int64) * width + one.x
        assert pixel.max(initial=0) < width * height
        return (pixel * 2 + one.p) * 10**10 + one.t

    found, asked = np.sort(line(events)), line(reference)
    after = np.searchsorted(found, asked)
    gaps = np.minimum(*(np.abs(found[np.clip(after + step, 0, len(found) - 1)] - asked) for step in (-1, 0)))
    return float((gaps <= within_us).mean()), float(np.median(gaps)) / 1000, len(events) / len(reference)


def scene_reference() -> Events:
    """Of the scene at 8,000 frames a second, seen one after the other."""
    frames, sensor = SceneFrames(8000), None
    chunks = []
    for t_us, light in frames:
        sensor = sensor or Sensor((light.shape[1], light.shape[0]), PRESETS["ideal"], sensor_seed=0, seed=0)
        chunks.append(sensor.push(light[None], np.array([t_us], np.int64)))
    return join(chunks, chunks[0].sensor_size)


def video_reference(path: Path, options: FrameOptions, last_us: int) -> Events:
    """Of all frames up to the last one that is given; between them light is a line."""
    times, frames = zip(*(one for one in open_frames(path, options) if one[0] <= last_us), strict=True)
    return simulate_events(np.stack(frames), np.array(times, np.int64), PRESETS["ideal"], sensor_seed=0, seed=0)


def main() -> None:
    """Print the table; without a video, of the scene alone."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--video", type=Path, default=VIDEO)
    parser.add_argument("--size", default="346x260", type=parse_sensor_size)
    parser.add_argument("--every", type=int, default=10, help="of how many frames of the video one is given")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    ideal, options, path = PRESETS["ideal"], FrameOptions(size=arguments.size), arguments.video
    has_video = path.is_file()
    if not has_video:
        print(f"{path}: no video there, so its columns are left out (--video names another)")
    truth = scene_reference()
    given = EveryNth(open_frames(path, options), arguments.every) if has_video else None
    reference = video_reference(path, options, max(t for t, _ in given)) if given is not None else None
    head = "| | scene: found within 1 ms | median | events | "
    print(head + ("video: found within 10 ms | median | events | time | rate | ON |" if has_video else ""))
    for name, way in WAYS.items():
        cells = "{:.3f} | {:.2f} ms | {:.2f}".format(*compare(way(SceneFrames(60), ideal), truth, 1000))
        if given is not None and reference is not None:
            cells += " | {:.3f} | {:.1f} ms | {:.2f}".format(*compare(way(given, ideal), reference, 10_000))
            seconds = []
            for _ in range(ROUNDS):
                frames = open_frames(path, options)
                started = time.process_time()
                events = way(frames, NOISY)
                duration_s = 1e-6 * frames.shown[-1].t_us
                seconds.append((time.process_time() - started) / duration_s)
            cells += (
                f" | {statistics.median(seconds):.2f} s | {len(events) / duration_s / 1e6:.3f} | {events.p.mean():.3f}"
            )
        print(f"| {name} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
