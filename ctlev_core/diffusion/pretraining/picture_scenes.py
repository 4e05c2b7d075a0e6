"""A user's labelled pictures as scenes: in a random style, with a caption, for pre-training and fine-tuning alike."""

from __future__ import annotations

import numpy as np

from ctlev_core.diffusion.pretraining.picture_styles import DataMixture, Scene, apply_style
from ctlev_core.pictures import labelled_pictures
from ctlev_core.pictures.labelled_pictures import LabelledPictures, PictureOptions


def picture_mixture(options: PictureOptions) -> DataMixture:
    """The styles and captions of the user's pictures."""
    return DataMixture(styles=options.styles, bare_caption_share=options.bare_caption_share)


def scene_of(
    pictures: LabelledPictures, row: int, options: PictureOptions, size: int, rng: np.random.Generator
) -> Scene:
    """Picture `row`, moved at random, [size, size, 3] px, and one of the names of its class."""
    name = pictures.names[row]
    called = str(rng.choice([name, *options.synonyms.get(name, ())])).replace("_", " ")
    image = labelled_pictures.move(pictures.read(row, size), options, rng)
    return Scene(image, None, called, called)


class Rehearsal:
    """The pictures that a base model learnt from, shown again while it learns event images.

    Without them it forgets how different things of a class look, and what it has seen no events of: the loss that keeps
    what a model knows beside what it learns (Ruiz et al., DreamBooth, CVPR 2023), with real pictures.
    """

    def __init__(self, options: PictureOptions, size: int) -> None:
        """Look through the pictures that `options.root` names.

        Raises:
            DataError: as `open_pictures`.
        """
        self._options, self._size = options, size
        self._pictures = labelled_pictures.open_pictures(options)
        self._mixture = picture_mixture(options)

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, list[str]]:
        """Random pictures [count, S, S, 3] uint8 and their captions."""
        images, captions = [], []
        for row in rng.integers(len(self._pictures), size=count).tolist():
            scene = scene_of(self._pictures, row, self._options, self._size, rng)
            image, caption = apply_style(scene, rng, self._mixture)
            images.append(image)
            captions.append(caption)
        return np.stack(images), captions
