"""Baseline: Event-GAN learns event images from pairs of intensity frames.

Source: Zhu et al., EventGAN: Leveraging Large Scale Image Datasets for Event Cameras, ICCP 2021, and the authors'
released code; ControlEvents (Hu et al., WACV 2026) compares with it. Network, discriminator, hinge loss, label noise,
augmentation, optimiser and the ratio of updates are the published ones; `Options` names each value that differs.
What differs in kind:

- The network makes event images, volumes of one temporal bin a polarity in the place of nine, for images are what all
  generators here are compared by.
- The cycle losses through pre-trained flow and reconstruction networks are left out, `ctlev_core.event_gan.losses` says
  why; an absolute difference to the real events can take their place.
- The generator that is kept is a moving average, the best of its checkpoints on a part of the training pairs that is
  held back, judged by `ctlev_core.event_gan.local_statistics`.
- Real-valued volumes become sparse images by a stated rule, which the publication has none of.

Like the published network it has no noise input: of one pair it makes one image.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ctlev_core.event_gan.options import SamplingOptions, TrainingOptions
from data_contracts.config import cache_material
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions, History

VERSION = 1


class Options(TrainingOptions):
    """Training options."""


class SampleOptions(SamplingOptions):
    """Sampling options."""


def base_model_folders(options: Options) -> list[Path]:
    """None: all weights are drawn from the seed."""
    return []


def train(frames: Images, conditions: Conditions, options: Options, *, seed: int, out: Path, work: Path) -> History:
    """Train on real event images and the intensity frames around them, and write the generator.

    Args:
        frames: [N, H, W, 3] uint8 event images, grey (polarity discarded) or red and blue.
        conditions: N prompts, which are not used, and [N, H, W, 3] uint8 images: channel 0 = grey frame at the window's
            start, channel 1 = at its end, channel 2 = 0.
        options: see `Options`.
        seed: of first weights, order, augmentation and the part held back.
        out: the checkpoint folder to write: `model.safetensors` and `config.json`.
        work: resumable state.
    Returns:
        The generator's loss; as validation loss the error of local statistics on the pairs held back, and as shuffled
        loss the same error with the images of other pairs. The discriminator's loss is in `config.json`.
    Raises:
        ValueError: there are no condition images, or they are too small for the networks.
        DataError: frames are not event images, or do not fit the conditions, or those are not pairs.
        TrainingError: a loss is not finite, or `work` holds the state of another run.
    """
    from ctlev_core.event_gan import batches, event_images, networks, sampling, training
    from ctlev_core.supervised import models

    pairs = event_images.check_pairs(conditions, "train Event-GAN")
    palette = event_images.check_event_images(frames, pairs, "train Event-GAN")
    height, width = frames.shape[1:3]
    networks.check_image_size(height, width, options)
    one_event = event_images.one_event_value(frames)
    data = batches.Pairs(pairs, frames, palette, one_event)
    material = cache_material(options)
    identity = models.digest(sampling.NAME, VERSION, material, seed, frames, pairs)
    gan = training.train_generator(data, options, seed=seed, work=work, identity=identity)
    network = networks.without_spectral_norm(gan.finish())
    curves = gan.curves
    record = {
        "version": VERSION,
        "options": material,
        "best_step": curves.best_step,
        "discriminator_loss": curves.discriminator_loss,
    }
    checkpoint = sampling.Checkpoint(network, palette, one_event, (width, height))
    sampling.write_checkpoint(out, checkpoint, networks.generator_arguments(options), record)
    return curves.history


def sample(
    checkpoint: Path, conditions: Conditions, options: SampleOptions, *, seeds: Sequence[int], work: Path
) -> np.ndarray:
    """Frames [N, H, W, 3] uint8 of N pairs; row i depends on pair i alone, with stochastic rounding on seed i as well.

    Raises:
        ValueError: there are no condition images, or not one seed a pair.
        DataError: the images are not pairs of the size of training, or the checkpoint is of another kind or damaged.
    """
    from ctlev_core.event_gan import event_images, sampling

    pairs = event_images.check_pairs(conditions, "sample Event-GAN")
    trained = sampling.load_checkpoint(checkpoint, options.device)
    sampling.check_sampling(trained, pairs, seeds)
    return sampling.sample_frames(trained.network, pairs, trained.palette, trained.one_event, options, seeds=seeds)
