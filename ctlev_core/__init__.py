"""ctlev: labelled event-camera data from a fine-tuned image-diffusion model.

    import ctlev_core as ctlev

    events = ctlev.read_events("recording.raw")
    counts = ctlev.histogram(events, num_events=7500)

The names of `__all__` are the public interface (docs/quick_start.md has a line for each). They are imported when they
are first used: `import ctlev_core` takes no time, and torch is loaded only by what needs it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ctlev_core.api import frechet as frechet
    from ctlev_core.api import histogram as histogram
    from ctlev_core.api import mpjpe as mpjpe
    from ctlev_core.api import normal_map as normal_map
    from ctlev_core.api import pck as pck
    from ctlev_core.api import read_events as read_events
    from ctlev_core.api import read_frames as read_frames
    from ctlev_core.api import read_imu as read_imu
    from ctlev_core.api import simulate as simulate
    from ctlev_core.api import simulate_video as simulate_video
    from ctlev_core.api import skeleton_map as skeleton_map
    from ctlev_core.export.event_dataset import EventDataset as EventDataset
    from ctlev_core.trained_generator import TrainedGenerator as TrainedGenerator
    from ctlev_core.trained_generator import load_generator as load_generator

__version__ = "0.1.0"
__all__ = [
    "EventDataset", "TrainedGenerator", "frechet", "histogram", "load_generator", "mpjpe", "normal_map", "pck",
    "read_events", "read_frames", "read_imu", "simulate", "simulate_video", "skeleton_map",
]  # fmt: skip

_ELSEWHERE = {
    "EventDataset": "ctlev_core.export.event_dataset",
    "TrainedGenerator": "ctlev_core.trained_generator",
    "load_generator": "ctlev_core.trained_generator",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(_ELSEWHERE.get(name, "ctlev_core.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
