"""Statistics of single event images: isolated and hot pixels, contrast, correlation of neighbours, power spectrum.

All are of a pixel's value, its largest channel, 0 .. 255, and of whole frames, dark borders included.
"""

from __future__ import annotations

import numpy as np

HOT_VALUE, HOT_VALUE_FACTOR = 128, 4.0


def count_isolated(active: np.ndarray) -> int:
    """Active pixels none of whose 8 neighbours is active.

    Args:
        active: [H, W] bool.
    """
    import cv2

    image = active.astype(np.uint8)
    around = cv2.boxFilter(image, cv2.CV_16S, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT) - image
    return int((active & (around == 0)).sum())


def count_hot(values: np.ndarray) -> int:
    """Pixels of at least `HOT_VALUE` and more than `HOT_VALUE_FACTOR` times the second largest of their neighbours.

    Of one image a hot pixel of the sensor, which fires all the time, cannot be told from noise that happened to be as
    bright. The second largest, because two hot pixels may touch.

    Args:
        values: [H, W] uint8.
    """
    from ctlev_core.realism import kernels

    if not (values >= HOT_VALUE).any():
        return 0
    is_hot = np.empty(values.shape, bool)
    kernels.find_hot_pixels(values.astype(np.int64), HOT_VALUE_FACTOR, HOT_VALUE, is_hot)
    return int(is_hot.sum())


def rms_contrast(values: np.ndarray) -> float:
    """Standard deviation of the values over full scale, 0 .. 0.5.

    Source: Peli, Contrast in complex images, Journal of the Optical Society of America A 7, 1990.

    Args:
        values: [H, W] uint8.
    """
    return float(values.std() / 255)


def neighbour_correlation(values: np.ndarray) -> float:
    """Pearson correlation of the values of pixels side by side and above one another; NaN where all are equal.

    Each pair counts once each way round.

    Args:
        values: [H, W] uint8.
    """
    image = values.astype(np.float64)
    pairs = [(image[:, :-1], image[:, 1:]), (image[:-1], image[1:])]
    first, second = (np.concatenate([pair[side].reshape(-1) for pair in pairs]) for side in (0, 1))
    both = np.concatenate([first, second])
    if both.size == 0 or (both == both[0]).all():
        return float("nan")
    middle = both.mean()
    return float(((first - middle) * (second - middle)).mean() / ((both - middle) ** 2).mean())


def radial_frequencies(image_size: tuple[int, int]) -> np.ndarray:
    """Distance of each term of the discrete Fourier transform from zero frequency.

    Args:
        image_size: H, W in px.
    Returns:
        [H, W] cycles per px, at most sqrt(0.5), in the order of `numpy.fft.fft2`.
    """
    rows, columns = (np.fft.fftfreq(length) for length in image_size)
    return np.hypot(rows[:, None], columns[None])


def power_shares(values: np.ndarray) -> np.ndarray | None:
    """Each frequency's share of an image's power without its mean; None where all values are equal.

    No window: borders of event images are dark, mostly.

    Args:
        values: [H, W] uint8.
    Returns:
        [H, W] adding up to 1, in the order of `numpy.fft.fft2`.
    """
    if values.size == 0 or (values == values.flat[0]).all():
        return None
    power = np.abs(np.fft.fft2(values.astype(np.float64) - values.mean())) ** 2
    power[0, 0] = 0
    return power / power.sum()
