"""A trained pixel decoder, ready to draw event images anew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.diffusion.pretrained.loading import choose_device
from ctlev_core.pixel_decoder.drawing import draw_values, frames_of_planes
from ctlev_core.pixel_decoder.files import load_decoder
from ctlev_core.pixel_decoder.network import PixelNetwork
from ctlev_core.pixel_decoder.options import PixelDecoderOptions
from ctlev_core.pixel_decoder.value_classes import ValueClasses
from ctlev_core.plugins import Plugin
from data_contracts.image_rows import Images


@dataclass(frozen=True, eq=False)
class PixelDecoder:
    """What `redraw` needs.

    Attributes:
        network: on the device to compute on.
        classes: of its counts.
        conditioned: whether it takes condition images.
        whole_counts: whether its values are event counts, which `encoder` renders, or grey levels.
        interval_us: from one frame to the next, where it sees what it drew for the frame before; else None.
        options: number of passes and precision.
        encoder: the encoding of the recorded frames.
    """

    network: PixelNetwork
    classes: ValueClasses
    conditioned: bool
    whole_counts: bool
    interval_us: int | None
    options: PixelDecoderOptions
    encoder: Plugin

    def redraw(
        self,
        frames: Images,
        conditions: Images | None,
        seeds: Sequence[int],
        lengths: Sequence[int] | None = None,
    ) -> Iterator[np.ndarray]:
        """Event images with the pixel values of recorded ones, one after another.

        Args:
            frames: [N, H, W, 3] uint8 as the generator gives them.
            conditions: [N, H, W, 3] uint8 that they were asked for; None = there are none.
            seeds: N non-negative integers; image i depends on its own row alone, and on those before it in its stretch
                where the decoder sees the frame before.
            lengths: frames of each stretch, which lie behind one another; None = each frame is by itself.
        Yields:
            [H, W, 3] uint8.
        """
        drawn = draw_values(
            self.network,
            self.classes,
            frames,
            conditions if self.conditioned else None,
            seeds=seeds,
            num_passes=self.options.num_passes,
            precision=self.options.precision,
            lengths=lengths if self.interval_us else None,
            moving_noise=self.options.moving_noise,
        )
        for values in drawn:
            if self.whole_counts:
                yield self.encoder.module.render_image(values[None], self.encoder.options)[0]
            else:
                yield frames_of_planes(values[None])[0]


def open_decoder(folder: Path, options: PixelDecoderOptions, encoder: Plugin) -> PixelDecoder:
    """Load a decoder.

    Args:
        folder: of `save_decoder`.
        options: number of passes, precision and device.
        encoder: the encoding of the recorded frames.
    Raises:
        DataError: the folder holds no pixel decoder.
    """
    return PixelDecoder(*load_decoder(folder, choose_device(options.device)), options, encoder)
