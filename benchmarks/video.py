"""Video to events: frames between frames, events, and time, by optical flow and by fading.

    python benchmarks/video.py [--video FILE] [--size 346x260]

Without a video: a textured scene in closed form that moves at 446 px a second, filmed at 60 frames a second, beside the
events of the same scene at 8,000 frames a second (ideal sensor): which share of those is found within a millisecond
at the same pixel, with the same polarity. With one: every second frame is left out and drawn anew, and compared with
what was there, over the pixels that change; and the time that a second of video takes on one core.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from ctlev_core.events.decoding.event_tables import parse_sensor_size
from ctlev_core.sensor.dvs_pixel import PRESETS, join, simulate_events
from ctlev_core.video.frames import FrameOptions, Frames, open_frames
from ctlev_core.video.interpolation import Between, Fading, Flow
from ctlev_core.video.simulation import VideoSimulation
from data_contracts.events import Events

SIZE = (192, 144)
SPEED_PX_S = (420.0, -150.0)
CHANGED = 8
"""Grey levels of 255 between two frames from which on a pixel counts."""
SETTINGS = {
    "fade": (Fading, 0.5),
    "flow, 2 px": (Flow, 2.0),
    "flow, 1 px": (Flow, 1.0),
    "flow, 0.5 px": (Flow, 0.5),
    "flow, 0.25 px": (Flow, 0.25),
}


class SceneFrames(Frames):
    """The scene at a rate."""

    def __init__(self, rate_hz: float, duration_s: float = 0.5) -> None:
        self.times = np.rint(np.arange(0, duration_s + 1e-9, 1 / rate_hz) * 1e6).astype(np.int64)
        self.expected = len(self.times)

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        for t_us in self.times.tolist():
            yield t_us, scene(t_us * 1e-6)


def scene(t_s: float) -> np.ndarray:
    """[H, W] linear light."""
    x, y = np.meshgrid(np.arange(SIZE[0]) - SPEED_PX_S[0] * t_s, np.arange(SIZE[1]) - SPEED_PX_S[1] * t_s)
    texture = np.sin(0.31 * x + 0.8) * np.sin(0.23 * y) + 0.6 * np.sin(0.12 * x - 0.17 * y + 1.0)
    bars = np.tanh(4 * np.sin(0.09 * x + 0.05 * y))
    return (0.35 + 0.12 * texture + 0.12 * bars).clip(0.02, 1).astype(np.float32)


def share_found(events: Events, reference: Events, within_us: int) -> float:
    """The share of the reference's events that have one of the same pixel and polarity near in time."""

    def line(one: Events) -> np.ndarray:
        return ((one.y.astype(np.int64) * SIZE[0] + one.x) * 2 + one.p) * 10**9 + one.t

    found, asked = np.sort(line(events)), line(reference)
    after = np.searchsorted(found, asked)
    gaps = [np.abs(found[np.clip(after + step, 0, len(found) - 1)] - asked) for step in (-1, 0)]
    return float((np.minimum(*gaps) <= within_us).mean())


def in_closed_form() -> None:
    """Print the table of the scene."""
    dense = SceneFrames(8000)
    frames = np.stack([light for _, light in dense])
    reference = simulate_events(frames, dense.times, PRESETS["ideal"], sensor_seed=0, seed=[0, 1])
    print(f"scene, {len(reference)} events of 8,000 frames a second")
    print("60 frames a second   events   found within 1 ms   that are of the reference   s")
    for name, (interpolator, displacement) in SETTINGS.items():
        started = time.perf_counter()
        simulation = VideoSimulation(
            SceneFrames(60), PRESETS["ideal"], interpolator=interpolator(), max_displacement_px=displacement
        )
        events = join(list(simulation), SIZE)
        elapsed = time.perf_counter() - started
        found, known = share_found(events, reference, 1000), share_found(reference, events, 1000)
        print(f"{name:20} {len(events):7}   {found:17.3f}   {known:25.3f}   {elapsed:.2f}")


def of_a_video(path: Path, options: FrameOptions) -> None:
    """Print how near frames that were left out are drawn, and how long a second of video takes."""
    frames = [light for _, light in open_frames(path, options)]
    triples = list(zip(frames[:-2:2], frames[1:-1:2], frames[2::2], strict=False))
    squares = {"flow": 0.0, "fade": 0.0, "frame before": 0.0}
    pixels = 0
    flow = Flow()
    for first, truth, second in triples:
        changed = np.abs(grey(second) - grey(first)) > CHANGED
        drawn = {
            "flow": drawn_frame(flow.between(first, second), first, second),
            "fade": (first + second) / 2,
            "frame before": first,
        }
        pixels += int(changed.sum())
        for name, one in drawn.items():
            squares[name] += float(((grey(one) - grey(truth))[changed] ** 2).sum())
    print(f"\n{path.name}: {len(triples)} frames left out and drawn anew; {pixels / len(triples):.0f} pixels change")
    for name, total in squares.items():
        print(f"{name:14} root mean square error {np.sqrt(total / pixels):5.2f} of 255")
    cv2.setNumThreads(1)
    for name, (interpolator, displacement) in SETTINGS.items():
        simulation = VideoSimulation(
            open_frames(path, options), PRESETS["dvs346"], interpolator=interpolator(), max_displacement_px=displacement
        )
        started = time.perf_counter()
        for _ in simulation:
            pass
        elapsed = time.perf_counter() - started
        seconds = simulation.duration_us / 1e6
        print(
            f"{name:14} {simulation.num_drawn / simulation.num_frames:5.1f} frames drawn a frame, "
            f"{simulation.num_events / seconds / 1e6:5.2f} million events a second, "
            f"{elapsed / seconds:5.2f} s of one core a second of video"
        )
    started = time.perf_counter()
    count = sum(1 for _ in open_frames(path, options))
    print(f"of which reading {1e3 * (time.perf_counter() - started) / count:.1f} ms a frame", end=", ")
    started = time.perf_counter()
    found = [flow.between(first, second) for first, second in pairwise(frames)]
    print(f"flow {1e3 * (time.perf_counter() - started) / len(found):.1f}", end=", ")
    started = time.perf_counter()
    for one in found:
        one.at(0.5)
    print(f"a frame between {1e3 * (time.perf_counter() - started) / len(found):.1f}")


def drawn_frame(between: Between, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The whole frame in the middle."""
    frame = (first + second) / 2
    frame.reshape(-1)[between.moving] = between.at(0.5)
    return frame


def grey(light: np.ndarray) -> np.ndarray:
    """As stored, 0 to 255."""
    return 255 * np.clip(light, 0, 1) ** (1 / 2.2)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--video", type=Path)
    parser.add_argument("--size", default="346x260", type=parse_sensor_size)
    arguments = parser.parse_args()
    in_closed_form()
    if arguments.video:
        of_a_video(arguments.video, FrameOptions(size=arguments.size))


if __name__ == "__main__":
    main()
