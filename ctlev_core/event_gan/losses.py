"""The losses of Event-GAN.

Hinge loss: Lim and Ye, Geometric GAN, 2017; Miyato et al., ICLR 2018, equations 16 and 17. Zhu et al. (ICCP 2021) add
two cycle losses through frozen networks that they train first, for optical flow and for image reconstruction, on
volumes of nine temporal bins. They are left out: an event image has one bin, which hardly tells the direction of the
motion that the flow loss constrains. In their place stands what the pairs at hand can supervise directly, the absolute
difference to the real events.
"""

from __future__ import annotations

import torch
from torch import Tensor


def discriminator_hinge_loss(real_logits: Tensor, generated_logits: Tensor) -> Tensor:
    """Mean max(0, 1 - D(real)) + mean max(0, 1 + D(generated)): 2 where the discriminator knows nothing, 0 where all.

    Args:
        real_logits: any shape.
        generated_logits: any shape.
    Returns:
        Scalar.
    """
    return torch.relu(1 - real_logits).mean() + torch.relu(1 + generated_logits).mean()


def generator_hinge_loss(generated_logits: Tensor) -> Tensor:
    """- mean D(generated), unbounded below: the generator's gradient never vanishes."""
    return -generated_logits.mean()


def flip_labels(real_logits: Tensor, generated_logits: Tensor, is_flipped: Tensor) -> tuple[Tensor, Tensor]:
    """Both sets of logits with those exchanged where `is_flipped`: one-sided noise that keeps the discriminator unsure.

    Args:
        real_logits: [B, 1, h, w].
        generated_logits: same shape.
        is_flipped: bool, same shape.
    """
    flipped_real = torch.where(is_flipped, generated_logits, real_logits)
    return flipped_real, torch.where(is_flipped, real_logits, generated_logits)


def reconstruction_loss(generated: Tensor, real: Tensor) -> Tensor:
    """Mean absolute difference of two volumes of the same shape (Isola et al., CVPR 2017)."""
    return (generated - real).abs().mean()
