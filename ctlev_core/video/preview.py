"""A picture of a simulated recording: some frames of the video, and below each the events until the next frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ctlev_core.video.frames import grey_levels
from ctlev_core.video.simulation import VideoSimulation
from data_contracts.errors import DataError
from data_contracts.events import Events

COLUMNS = 6
FULL_SCALE = 3
"""Events of a pixel that are drawn as bright as it gets."""


def check_picture_suffix(path: Path) -> None:
    """Raise `DataError` unless a picture can be written under this name."""
    import cv2

    if path.suffix and not cv2.haveImageWriter(str(path)):
        raise DataError(f"{path}: no picture is written with the suffix {path.suffix!r}; take .png or .jpg")


class Preview:
    """Gathers what it shows while events go by: frames evenly over the video, or the first ones if it says no end."""

    def __init__(self, simulation: VideoSimulation) -> None:
        self._simulation = simulation
        last = max(simulation.frames.expected - 2, COLUMNS - 1)
        self._shown = set(np.linspace(0, last, COLUMNS).astype(int).tolist())
        self._columns: list[tuple[np.ndarray, np.ndarray]] = []

    def watch(self) -> Iterator[Events]:
        """The events of the simulation."""
        for events in self._simulation:
            # Those that come while n frames are finished lie between frame n - 1 and frame n.
            light = self._simulation.last_light
            if light is not None and self._simulation.num_frames - 1 in self._shown:
                counts = np.zeros((2, *light.shape), np.int64)
                np.add.at(counts, (events.p, events.y, events.x), 1)
                self._columns.append((grey_levels(light), counts))
            yield events

    def write(self, path: Path) -> None:
        """Write the picture, PNG or what the suffix says: brighter is red, darker blue."""
        import cv2

        columns = []
        for grey, counts in self._columns:
            level = np.rint(255 * np.minimum(counts / FULL_SCALE, 1)).astype(np.uint8)
            # Blue, green, red: the order of OpenCV. A light ground, so that single events are seen.
            events = 255 - np.stack([level[1], np.maximum(level[0], level[1]), level[0]], axis=-1)
            columns.append(np.vstack([np.repeat(grey[..., None], 3, axis=2), events]))
        is_written, encoded = cv2.imencode(path.suffix or ".png", np.hstack(columns))
        assert is_written
        path.write_bytes(encoded.tobytes())
