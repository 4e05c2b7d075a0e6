"""An AEDAT 4 recording of a DAVIS with frames and inertial measurements, written by iniVation's own library."""

from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

START = 1_700_000_000_000_000
SIZE = (34, 26)


def library():
    """`dv_processing`; without it the test is skipped."""
    return pytest.importorskip("dv_processing", reason="iniVation's dv-processing has wheels for some platforms only")


def pictures():
    """Six frames, the last in colours."""
    random = np.random.default_rng(0)
    shape = SIZE[::-1]
    return [random.integers(0, 256, shape if number < 5 else (*shape, 3), np.uint8) for number in range(6)]


def measured():
    """Rows of temperature, acceleration, rotation, magnetic field."""
    return np.random.default_rng(1).normal(size=(700, 10)).astype(np.float32)


def write_davis(path: Path) -> Path:
    """100 events, frames of `pictures` (the last one without exposure), and `measured`."""
    dv = library()
    config = dv.io.MonoCameraWriter.Config("DAVIS346_00000001")
    config.addEventStream(SIZE)
    config.addFrameStream(SIZE)
    config.addImuStream()
    writer = dv.io.MonoCameraWriter(str(path), config)
    events = dv.EventStore()
    for number in range(100):
        events.push_back(START + 1000 * number, number % SIZE[0], number % SIZE[1], number % 3 == 0)
    writer.writeEvents(events)
    for number, picture in enumerate(pictures()):
        frame = dv.Frame(START + 25_000 * number, np.ascontiguousarray(picture[..., ::-1] if number == 5 else picture))
        if number < 5:
            frame.exposure = timedelta(microseconds=4000)
        writer.writeFrame(frame)
    for number, row in enumerate(measured()):
        writer.writeImu(dv.IMU(START + 500 * number, *row.tolist()))
    return path
