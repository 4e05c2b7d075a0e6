"""Curves and pictures of a running training, for TensorBoard."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np


class TrainingLog:
    """Writes scalars and pictures; without a TensorBoard folder only pictures, to the work folder."""

    def __init__(self, pictures: Path, writer: Any | None = None) -> None:
        self._pictures = pictures
        self._writer = writer

    def scalars(self, step: int, **values: float) -> None:
        """One point of each curve."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

    def picture(self, step: int, image: np.ndarray) -> None:
        """A picture [H, W, 3] uint8 of the samples after `step` steps."""
        import cv2

        self._pictures.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(self._pictures / f"step_{step:06d}.png"), image[..., ::-1])
        if self._writer is not None:
            self._writer.add_image("samples", image, step, dataformats="HWC")


@contextmanager
def training_log(tensorboard: Path | None, name: str, *, pictures: Path, first_step: int) -> Iterator[TrainingLog]:
    """The log of one run; a resumed run goes on in the same subfolder, over what it wrote after its last save.

    Args:
        tensorboard: folder for TensorBoard, or None.
        name: subfolder of the run.
        pictures: folder of the PNG files.
        first_step: steps already done.
    """
    if tensorboard is None:
        yield TrainingLog(pictures)
        return
    from tensorboardX import SummaryWriter

    # Files are named by the second they are opened in: without the step a quick resumption would overwrite the first.
    writer = SummaryWriter(str(tensorboard / name), purge_step=first_step or None, filename_suffix=f".{first_step}")
    try:
        yield TrainingLog(pictures, writer)
    finally:
        writer.close()


def picture_of_samples(columns: Sequence[np.ndarray | None]) -> np.ndarray:
    """A row an image, side by side condition, real frame and sample.

    Args:
        columns: arrays [N, H, W, 3] uint8 of one shape; None is left out.
    Returns:
        [N * H, columns * W, 3] uint8.
    """
    return np.concatenate([np.concatenate(list(images)) for images in columns if images is not None], axis=1)
