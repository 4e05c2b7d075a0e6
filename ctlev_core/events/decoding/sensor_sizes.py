"""The sensor size of files that do not state it."""

from __future__ import annotations

from collections.abc import Sequence

from data_contracts.errors import DataError
from data_contracts.events import SensorSize

COMMON_SENSORS: tuple[SensorSize, ...] = (
    (34, 34),  # N-MNIST
    (128, 128),  # DVS128
    (240, 180),  # DAVIS240, and N-Caltech101
    (304, 240),  # ATIS
    (320, 240),  # DVXplorer Lite and Mini
    (346, 260),  # DAVIS346
    (320, 320),  # GenX320
    (640, 480),  # Prophesee Gen3, VGA cameras, N-ImageNet, DSEC
    (1280, 720),  # Prophesee Gen4
    (1280, 800),  # CeleX-V
    (800, 1280),  # CeleX-V held upright (Event-HPE)
)
"""(width, height) in pixels, the smallest first."""

INIVATION_CAMERAS: dict[str, SensorSize] = {
    "DVS128": (128, 128),
    "DAVIS128": (128, 128),
    "DAVIS208": (208, 192),
    "DAVIS240": (240, 180),
    "DAVIS346": (346, 260),
    "DAVIS640": (640, 480),
}
"""Cameras by the start of the names that jAER and cAER give them, in capitals; (width, height) px."""


def smallest_sensor(
    largest_x: int, largest_y: int, where: str, sensors: Sequence[SensorSize] = COMMON_SENSORS
) -> SensorSize:
    """The first of `sensors` that holds all events.

    Raises:
        DataError: none does; the message names `where` and lists them.
    """
    for width, height in sensors:
        if largest_x < width and largest_y < height:
            return width, height
    known = ", ".join(f"{width} x {height}" for width, height in sensors)
    raise DataError(
        f"{where}: the file states no sensor size, and events up to x = {largest_x}, y = {largest_y} px fit none of "
        f"the known sensors {known}"
    )
