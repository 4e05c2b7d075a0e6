"""The styles that pictures are shown in for pre-training, and the captions that say what they are of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from pydantic import Field

from ctlev_core.pictures.labelled_pictures import StyleShares
from ctlev_core.studio.objects import NAMES
from data_contracts.config import Frozen

SAY_STYLE_SHARE = 0.6
MOTION_LENGTH, MOTION_STEPS = (0.06, 0.25), 8
"""Of the style `motion`: each line as a share of the side, and how many differences it is the sum of."""
GRAIN_SHARE = 0.1
PERSON_CAPTIONS = (
    "a moving human", "a moving human", "a moving human", "a photo of a person", "a photo of a moving person",
    "a human", "a photo of a man", "a photo of a woman", "a dancing person", "a person in the street",
)  # fmt: skip
OBJECT_CAPTIONS = (
    "a photo of {plain}", "a photo of a {plain}", "a {plain}", "a photo of a {coloured}", "a {coloured}",
    "a picture of a {coloured}",
)  # fmt: skip
"""The first three name no colour."""
STYLE_CAPTIONS = {
    "photo": "a colour photo of {}",
    "grey": "a grey photo of {}",
    "lines": "a line drawing of {}",
    "coloured lines": "a coloured line drawing of {}",
    "motion": "a moving picture of {}",
}


class DataMixture(Frozen):
    """What the pictures are of, in shares."""

    people_share: float = Field(default=0.5, ge=0, le=1, description="people among scenes; the others are things")
    styles: StyleShares = Field(
        default={"photo": 0.22, "grey": 0.1, "lines": 0.34, "coloured lines": 0.34}, description="they sum to 1"
    )
    plain_share: float = Field(
        default=0.75, ge=0, le=1, description="things on a plain background, whose line drawings are clean"
    )
    composition_share: float = Field(
        default=0.2, ge=0, le=1, description="two things in one picture, of those of things"
    )
    bare_caption_share: float = Field(
        default=0.0, ge=0, le=1, description="captions of things without colour and style, as fine-tuning's prompts are"
    )
    other_names_share: float = Field(
        default=0.0, ge=0, le=1, description="how many nouns a caption calls by any of their names"
    )


DEFAULT_MIXTURE = DataMixture()


@dataclass(frozen=True, eq=False)
class Scene:
    """A drawn scene before it gets a style.

    Attributes:
        image: [S, S, 3] uint8 RGB colours.
        condition: [S, S, 3] uint8 RGB, the person's skeleton or normal map; None for objects.
        plain: what is seen in words without colours: `person`, a key of `OBJECTS`, or such as `cat on box`.
        coloured: the same with colours, such as `red cat on blue box`; empty for people.
    """

    image: np.ndarray
    condition: np.ndarray | None
    plain: str
    coloured: str = ""


def apply_style(
    scene: Scene, rng: np.random.Generator, data_mixture: DataMixture = DEFAULT_MIXTURE
) -> tuple[np.ndarray, str]:
    """A random style for a scene.

    Returns:
        The picture [S, S, 3] uint8 and its caption.
    """
    shares = np.array(list(data_mixture.styles.values()))
    # They sum to 1 within 1e-6 (thirds are written so), and NumPy asks for more.
    style = str(rng.choice(list(data_mixture.styles), p=shares / shares.sum()))
    image = scene.image.astype(np.float32)
    if style == "grey" or style == "lines":
        image = np.repeat(image @ np.array([[0.299], [0.587], [0.114]], np.float32), 3, axis=2)
    if style.endswith("lines"):
        image = _outlines(image, rng)
    elif style == "motion":
        image = _changes(image, rng)
    if rng.random() < GRAIN_SHARE:  # of film
        image = image + rng.normal(0, rng.uniform(3, 14), image.shape[:2])[..., None]
    picture = np.clip(image, 0, 255).round().astype(np.uint8)
    return picture, _caption(scene, style, rng, data_mixture)


def _outlines(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Bright outlines on black: the gradient magnitude of each channel, thinned by a random threshold."""
    smooth = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 0.9))
    sobel = partial(cv2.Sobel, smooth, cv2.CV_32F, ksize=3, scale=0.125)
    magnitude = np.hypot(sobel(dx=1, dy=0), sobel(dx=0, dy=1))
    full = np.percentile(magnitude.max(axis=2), rng.uniform(93, 98.5)) + 4.0
    lines = np.clip((magnitude / full - rng.uniform(0.1, 0.35)) * rng.uniform(1.0, 1.8), 0, 1)
    return lines * rng.uniform(150, 255)


def _changes(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What changes while the picture moves along three random lines, one a channel: no sensor, no events.

    Each channel is the sum of absolute differences of brightness between neighbours in time.
    """
    side = image.shape[0]
    angles, lengths = rng.uniform(0, 2 * np.pi, 3), side * rng.uniform(*MOTION_LENGTH, 3)
    legs = np.stack([lengths * np.cos(angles), lengths * np.sin(angles)], axis=1)
    corners = np.concatenate([np.zeros((1, 2)), np.cumsum(legs, axis=0)])
    corners -= corners.mean(axis=0)
    grey = image @ np.array([0.299, 0.587, 0.114], np.float32)
    border = float(np.median(np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])))
    changes = np.zeros((*grey.shape, 3), np.float32)
    for channel in range(3):
        shares = np.linspace(0, 1, MOTION_STEPS + 1)[:, None]
        places = corners[channel] + shares * (corners[channel + 1] - corners[channel])
        shown = [_shifted(grey, place, border) for place in places]
        changes[..., channel] = np.abs(np.diff(shown, axis=0)).sum(axis=0)
    full = np.percentile(changes.max(axis=2), rng.uniform(95, 99.5)) + 4.0
    return np.clip(changes / full, 0, 1) * rng.uniform(150, 255)


def _shifted(grey: np.ndarray, place: np.ndarray, border: float) -> np.ndarray:
    matrix = np.array([[1, 0, place[0]], [0, 1, place[1]]], np.float32)
    size = grey.shape[1], grey.shape[0]
    return cv2.warpAffine(
        grey, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=border
    )


def _caption(scene: Scene, style: str, rng: np.random.Generator, data_mixture: DataMixture) -> str:
    if scene.condition is not None:
        caption = str(rng.choice(PERSON_CAPTIONS))
    else:
        # A grey picture has no colour to name.
        templates = OBJECT_CAPTIONS if style.startswith(("photo", "coloured")) else OBJECT_CAPTIONS[:3]
        caption = str(rng.choice(templates)).format(plain=scene.plain, coloured=scene.coloured)
    if rng.random() < SAY_STYLE_SHARE:
        subject = caption.removeprefix("a photo of ").removeprefix("a picture of ")
        caption = STYLE_CAPTIONS[style].format(subject)
    if style == "motion":  # never called a photo: event images come nearest to it, and are called something else again
        return _renamed(
            STYLE_CAPTIONS[style].format(scene.plain), scene.plain.split(), data_mixture.other_names_share, rng
        )
    # Asked only where it matters, so that other diets draw the same random numbers.
    if (
        scene.condition is None
        and data_mixture.bare_caption_share > 0
        and rng.random() < data_mixture.bare_caption_share
    ):
        caption = OBJECT_CAPTIONS[0].format(plain=scene.plain)
    return _renamed(caption, scene.plain.split(), data_mixture.other_names_share, rng)


def _renamed(caption: str, nouns: Sequence[str], share: float, rng: np.random.Generator) -> str:
    words = caption.split(" ")
    for noun in nouns:
        if share > 0 and noun in NAMES and noun in words and rng.random() < share:
            words[words.index(noun)] = str(rng.choice(NAMES[noun]))
    return " ".join(words)
