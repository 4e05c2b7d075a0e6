"""Text: a sentence with the name of the class, or with one of its synonyms.

Source: ControlEvents, the object-class experiments (N-Caltech101, N-ImageNet): "A photo of ..." prompts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field, field_validator

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 1
NEEDS = ""
PLACEHOLDER = "{class_name}"


class Options(Frozen):
    """Options of the text condition."""

    template: str = Field(
        default="A photo of {class_name}", description="The prompt; {class_name} stands for the name."
    )
    synonyms: dict[str, list[str]] = Field(
        default_factory=dict,
        description="Names to draw from, by class, for example WordNet lemmas; other classes keep their own name.",
    )

    @field_validator("template")
    @classmethod
    def _template_names_the_class(cls, template: str) -> str:
        if PLACEHOLDER not in template:
            raise ValueError(f"the template must contain {PLACEHOLDER}")
        return template

    @field_validator("synonyms")
    @classmethod
    def _synonyms_are_names(cls, synonyms: dict[str, list[str]]) -> dict[str, list[str]]:
        for class_name, names in synonyms.items():
            if not names or not all(name.strip() for name in names):
                raise ValueError(f"class {class_name!r} needs at least one synonym and no empty ones")
        return synonyms


def render(labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int]) -> Conditions:
    """One prompt a row, without images.

    Args:
        labels: N rows with class names; underscores become spaces.
        image_size: unused.
        options: template and synonyms.
        seeds: N integers; seed i alone decides which synonym row i gets.
    Raises:
        DataError: a row has no class name, or the number of seeds differs.
    """
    if len(seeds) != len(labels):
        raise DataError(f"condition 'text': {len(labels)} labels but {len(seeds)} seeds")
    prompts = []
    for row, (class_name, seed) in enumerate(zip(labels.class_names, seeds, strict=True)):
        if not class_name.strip():
            raise DataError(f"condition 'text': row {row} has no class name")
        names = options.synonyms.get(class_name, [class_name])
        name = names[np.random.default_rng(seed).integers(len(names))]
        prompts.append(options.template.replace(PLACEHOLDER, name.replace("_", " ").strip()))
    return Conditions(tuple(prompts))
