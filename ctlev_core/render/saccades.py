"""The path of a camera that makes the saccades of N-MNIST, and the frames that it takes to follow a path.

Source: N-MNIST and N-Caltech101 (Orchard et al., Frontiers in Neuroscience 2015): three saccades of about 100 ms along
a closed triangle. This path was measured on 276 recordings of N-MNIST, as that which leaves their events least blurred
when it is taken off them. The two motors do not run together: the tilt ends a saccade when the pan has hardly begun.
"""

from __future__ import annotations

import functools

import numpy as np

MAX_INTERVAL_US = 10_000
PATH_STEP_US = 250
PATH_MS_PX = (
    (0, 0.00, 0.00),
    (7.5, 0.00, 0.05),
    (15, 0.00, 0.23),
    (22.5, 0.00, 0.62),
    (30, 0.00, 1.15),
    (37.5, 0.00, 1.90),
    (45, 0.02, 2.81),
    (52.5, 0.29, 3.66),
    (60, 0.74, 4.35),
    (67.5, 1.21, 4.81),
    (75, 1.60, 5.13),
    (82.5, 1.70, 5.17),
    (90, 1.76, 5.17),
    (97.5, 1.82, 5.17),
    (105, 1.92, 5.15),
    (112.5, 2.07, 5.06),
    (120, 2.27, 4.94),
    (127.5, 2.59, 4.67),
    (135, 3.03, 4.19),
    (142.5, 3.46, 3.43),
    (150, 3.79, 2.55),
    (157.5, 4.04, 1.67),
    (165, 4.38, 0.84),
    (172.5, 4.73, 0.20),
    (180, 5.06, -0.07),
    (187.5, 5.29, -0.13),
    (195, 5.39, -0.13),
    (202.5, 5.56, -0.13),
    (210, 5.72, -0.15),
    (217.5, 5.80, -0.18),
    (225, 5.73, -0.18),
    (232.5, 5.27, -0.18),
    (240, 4.70, -0.18),
    (247.5, 4.01, -0.20),
    (255, 3.30, -0.22),
    (262.5, 2.53, -0.26),
    (270, 1.83, -0.35),
    (277.5, 1.32, -0.43),
    (285, 0.93, -0.47),
    (292.5, 0.62, -0.47),
    (300, 0.52, -0.47),
    (307.5, 0.50, -0.47),
)
"""ms, and px to the right and down, on a sensor of 34 x 34 px."""
NMNIST_PATH_US = tuple(round(1000 * row[0]) for row in PATH_MS_PX)
NMNIST_PATH_PX = tuple(row[1:] for row in PATH_MS_PX)


@functools.lru_cache(maxsize=4)
def path_frames(
    path_us: tuple[int, ...], path_px: tuple[tuple[float, float], ...], max_displacement_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """The frames that are needed to follow a path.

    Args:
        path_us: times of its points, ascending from 0.
        path_px: where the picture is then, (x right, y down); smooth in between.
        max_displacement_px: movement between two frames, which are never closer than a microsecond.
    Returns:
        Times [T] int64 us, and where [T, 2] px the picture is then against its start.
    """
    from scipy.interpolate import PchipInterpolator

    path = PchipInterpolator(np.array(path_us, float), np.array(path_px) - np.array(path_px[0]))
    fine_us = np.unique(np.append(np.arange(0, path_us[-1], PATH_STEP_US), path_us[-1]))
    steps = np.linalg.norm(np.diff(path(fine_us), axis=0), axis=1)
    # Each fine step is a share of a frame: by how far it moves, and by how long it lasts.
    with np.errstate(over="ignore"):
        shares = np.maximum(steps / max_displacement_px, np.diff(fine_us) / MAX_INTERVAL_US)
    progress = np.concatenate([[0.0], np.cumsum(shares)])
    if progress[-1] > path_us[-1]:
        times_us = np.arange(path_us[-1] + 1)  # times are whole us: there can be no more
    else:
        count = int(np.ceil(progress[-1])) + 1
        times_us = np.interp(np.linspace(0, progress[-1], count), progress, fine_us)
        times_us = np.unique(np.rint(times_us).astype(np.int64))
    return times_us, path(times_us)
