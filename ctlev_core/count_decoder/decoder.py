"""A trained count decoder, ready to draw event images anew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.count_decoder.count_classes import CountClasses
from ctlev_core.count_decoder.drawing import draw_counts
from ctlev_core.count_decoder.files import load_decoder
from ctlev_core.count_decoder.network import CountNetwork
from ctlev_core.count_decoder.options import CountDecoderOptions
from ctlev_core.diffusion.pretrained.loading import choose_device
from ctlev_core.plugins import Plugin
from data_contracts.image_rows import Images


@dataclass(frozen=True, eq=False)
class CountDecoder:
    """What `redraw` needs.

    Attributes:
        network: on the device to compute on.
        classes: of its counts.
        conditioned: whether it takes condition images.
        options: number of passes and precision.
        encoder: the event histogram that counts are rendered as.
    """

    network: CountNetwork
    classes: CountClasses
    conditioned: bool
    options: CountDecoderOptions
    encoder: Plugin

    def redraw(self, frames: Images, conditions: Images | None, seeds: Sequence[int]) -> Iterator[np.ndarray]:
        """Event images of whole counts, one after another.

        Args:
            frames: [N, H, W, 3] uint8 as the generator gives them.
            conditions: [N, H, W, 3] uint8 that they were asked for; None = there are none.
            seeds: N non-negative integers; image i depends on its own row alone.
        Yields:
            [H, W, 3] uint8.
        """
        drawn = draw_counts(
            self.network,
            self.classes,
            frames,
            conditions if self.conditioned else None,
            seeds=seeds,
            num_passes=self.options.num_passes,
            precision=self.options.precision,
        )
        for counts in drawn:
            yield self.encoder.module.render_image(counts[None], self.encoder.options)[0]


def open_decoder(folder: Path, options: CountDecoderOptions, encoder: Plugin) -> CountDecoder:
    """Load a decoder.

    Args:
        folder: of `save_decoder`.
        options: number of passes, precision and device.
        encoder: the event histogram of the recorded frames.
    Raises:
        DataError: the folder holds no count decoder.
    """
    network, classes, conditioned = load_decoder(folder, choose_device(options.device))
    return CountDecoder(network, classes, conditioned, options, encoder)
