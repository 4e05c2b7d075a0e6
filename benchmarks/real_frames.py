"""Twelve real frames as images of 64, 256 and 512 px, one frame a row: what resampling does to real events.

    python benchmarks/real_frames.py --real FOLDER [--out docs/real_frames.png]

FOLDER holds `dhp19_frames` (released event images), `nmnist` (34 x 34 px) and `events` (AEDAT4, EVT2, EVT3). Says for
each frame, as one line, which share of an image of 512 px is lit, and how much was with events put into image pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from ctlev_core.encodings import event_histogram
from ctlev_core.events import files as event_files

SIZES = (64, 256, 512)
GAP_PX = 8
DIGITS = ("three", "five", "eight", "nine")
# Recording and how many events make one of its two frames.
RECORDINGS = {
    "person/tonic_sample.aedat4": 15_000,
    "spot/expelliarmus_evt2.raw": 100_000,
    "street/expelliarmus_evt3.raw": 100_000,
}


def main() -> None:
    """Draw the picture, and print the shares of lit pixels."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, required=True, help="folder of real recordings")
    parser.add_argument("--out", type=Path, default=Path("docs/real_frames.png"))
    arguments = parser.parse_args()
    rows = [*released(arguments.real), *counted(arguments.real)]
    height = len(rows) * (SIZES[-1] + GAP_PX) - GAP_PX
    page = np.full((height, sum(SIZES) + GAP_PX * (len(SIZES) - 1), 3), 255, np.uint8)
    for number, images in enumerate(rows):
        top, left = number * (SIZES[-1] + GAP_PX), 0
        for image in images:
            side = len(image)
            page[top : top + side, left : left + side] = image
            left += side + GAP_PX
    Image.fromarray(page).save(arguments.out, optimize=True)
    print(f"{arguments.out}: {len(rows)} frames, {arguments.out.stat().st_size / 1000:.0f} kB")


def released(real: Path) -> Iterator[list[np.ndarray]]:
    """DHP19's event images, as its authors made them."""
    for path in sorted((real / "dhp19_frames").glob("*.png")):
        levels = np.array(Image.open(path).convert("L"))[None, None]
        images = [
            event_histogram.render_levels(levels, event_histogram.Options(polarity=False, image_size=(side, side)))[0]
            for side in SIZES
        ]
        yield tell(path.name, levels[0, 0] > 0, images)


def counted(real: Path) -> Iterator[list[np.ndarray]]:
    """Whole recordings of N-MNIST, and two windows of each of the others."""
    chosen = [(sorted((real / "nmnist" / digit).glob("*.bin"))[0], 0) for digit in DIGITS]
    chosen += [(real / "events" / name, num_events) for name, num_events in RECORDINGS.items()]
    for path, num_events in chosen:
        events = event_files.read_events_file(path)
        starts = [0] if num_events == 0 else [0, len(events) - num_events]
        windows = np.array([[start, start + (num_events or len(events))] for start in starts])
        for window in windows:
            images = []
            for side in SIZES:
                options = event_histogram.Options(image_size=(side, side))
                counts = event_histogram.encode(events, window[None], options)
                images.append(event_histogram.render_image(counts, options)[0])
            yield tell(path.name, counts[0].any(axis=0), images)


def tell(name: str, active: np.ndarray, images: list[np.ndarray]) -> list[np.ndarray]:
    """Print the share of the largest image that is lit, and hand the images on."""
    options = event_histogram.Options(image_size=(SIZES[-1],) * 2, resampling="events")
    columns, rows = event_histogram.image_grid.pixel_bins(active.shape[::-1], options)
    put = np.zeros(images[-1].shape[:2], bool)
    where = np.argwhere(active)
    put[rows[where[:, 0]], columns[where[:, 1]]] = True
    lit = images[-1].any(axis=2).mean()
    print(f"{name}: {len(images[-1])} px, lit {lit:.3f}; with events put into pixels {put.mean():.3f}")
    return images


if __name__ == "__main__":
    main()
