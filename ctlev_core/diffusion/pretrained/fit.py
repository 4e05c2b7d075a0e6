"""Does a base model fit the event images and conditions of an experiment? Told by configs, where it is planned."""

from __future__ import annotations

from pathlib import Path

from ctlev_core import plugins
from ctlev_core.diffusion.pretrained.paths import find_controlnet, read_controlnet, read_parts
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError


def check_fit(
    base_model: Path,
    image_size: tuple[int, int] | None,
    condition: ConditionChoice,
    *,
    controlnet: Path | None = None,
    with_controlnet: bool = False,
) -> None:
    """Raise `DataError` where event images are not of the size that a base model makes, or colours are exchanged.

    Args:
        base_model: a diffusers folder or a single file. That it is there and whole is checked elsewhere.
        image_size: (width, height) px of the event images; None = not known before recordings are read.
        condition: of the ControlNet.
        controlnet: as for `find_controlnet`.
        with_controlnet: the ControlNet is used.
    """
    check_image_size(base_model, image_size)
    place = find_controlnet(base_model, controlnet) if with_controlnet else None
    if place is not None:
        order = read_controlnet(place).config.get("controlnet_conditioning_channel_order", "rgb")
        check_channel_order(order, condition)


def check_image_size(base_model: Path, image_size: tuple[int, int] | None) -> None:
    """Raise `DataError` where event images are not of the size that a base model makes; arguments as `check_fit`."""
    parts = read_parts(base_model).parts
    side = parts["unet"].config["sample_size"] * 2 ** (len(parts["vae"].config["block_out_channels"]) - 1)
    if image_size is not None and tuple(image_size) != (side, side):
        raise DataError(
            f"{base_model}: this base model makes images of {side} x {side} px, event images are {image_size[0]} x "
            f"{image_size[1]} px; set encoding.options.image_size=[{side},{side}]"
        )


def check_channel_order(order: str, condition: ConditionChoice | None) -> None:
    """Raise `DataError` where a ControlNet exchanges red and blue of normal maps that are drawn so already, or not.

    Nothing else would notice: it learns slowly, from weights that know other colours.

    Args:
        order: `rgb` or `bgr`, `controlnet_conditioning_channel_order` of the ControlNet's config.
        condition: the plug-in that draws the condition images, where it is known.
    """
    convention = ""
    if condition is not None and condition.name == "normals":
        convention = plugins.load_options(condition).options.convention
    if (convention, order) in (("controlnet", "bgr"), ("controlnet_unreversed", "rgb")):
        fitting = "controlnet_unreversed" if order == "bgr" else "controlnet"
        raise DataError(
            f"condition 'normals': convention {convention!r} does not fit a ControlNet whose channel order is "
            f"{order!r}; set condition.options.convention={fitting}"
        )
