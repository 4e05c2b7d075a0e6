"""Where the pre-trained weights lie, and whether they are there and fit. Imports nothing heavy: the plan calls it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ctlev_core.diffusion.pretrained.checks import check_parts
from ctlev_core.diffusion.pretrained.components import (
    ZERO_EMPTY_PROMPT,
    ModelFiles,
    ModelPart,
    read_json,
    read_part,
)
from ctlev_core.diffusion.pretrained.flow_checks import check_flow_parts, check_transformer_class
from ctlev_core.diffusion.pretrained.model_kinds import TRANSFORMER
from ctlev_core.diffusion.pretrained.single_file import (
    ENDINGS,
    files_beside,
    is_single_file,
    read_single_base_model,
    read_single_controlnet,
)
from ctlev_core.safe_files.tensor_files import check_finite
from data_contracts.errors import DataError

BUNDLED_BASE_MODEL = Path(__file__).resolve().parents[2] / "base_models" / "small"
"""Of people, and a little of things: what ControlNets steer."""
BUNDLED_OBJECT_MODEL = BUNDLED_BASE_MODEL.with_name("small_objects")
"""The same networks without ControlNet, taught the names of things: for the text route."""
COMPONENTS = ("tokenizer", "text_encoder", "vae", "unet", "scheduler")
TRANSFORMER_COMPONENTS = ("tokenizer", "text_encoder", "tokenizer_2", "text_encoder_2", "vae", "scheduler")


def read_base_model_files(path: Path, *, controlnet: Path | None = None, with_controlnet: bool = True) -> ModelFiles:
    """Configs and tensor tables of a base model, checked: all there, of one architecture, without NaN.

    Args:
        path: a diffusers folder with the subfolders of `COMPONENTS` and perhaps `controlnet`, or a Stable Diffusion v1
            checkpoint in one file, with the tokenizer's folder beside it.
        controlnet: as for `find_controlnet`.
        with_controlnet: False leaves the ControlNet out.
    Raises:
        DataError: what is missing or does not fit, what was expected, and where.
    """
    if not path.exists():
        raise DataError(
            f"{path}: the base model must be a diffusers folder, or a checkpoint in one file ({', '.join(ENDINGS)}), "
            "but there is no such folder or file"
        )
    files = read_parts(path)
    parts = dict(files.parts)
    control = find_controlnet(path, controlnet) if with_controlnet else None
    if control is not None:
        parts["controlnet"] = read_controlnet(control)
    elif not with_controlnet:
        parts.pop("controlnet", None)
    files = dataclasses.replace(files, parts=parts)
    is_transformer = files.parts["unet"].config.get("_class_name") == TRANSFORMER
    (check_flow_parts if is_transformer else check_parts)(files)
    for part in files.parts.values():
        check_finite(part.tensors.items())
    return files


def read_parts(path: Path) -> ModelFiles:
    """Configs and tensor tables of a base model's folder or single file, not checked against one another."""
    return read_single_base_model(path) if is_single_file(path) else _read_folder(path)


def check_base_model_folder(folder: Path, *, controlnet: Path | None = None, needs_controlnet: bool = False) -> Path:
    """Raise unless there is a base model whose weights can be read; see `read_base_model_files`.

    Args:
        folder: or a single file.
        controlnet: as for `find_controlnet`.
        needs_controlnet: raise where the base model has none and none is given; where neither this is asked for nor a
            ControlNet, the base model's own is not looked at.
    Returns:
        The folder or file.
    Raises:
        DataError: what is missing or does not fit, and where it was looked for.
    """
    wanted = needs_controlnet or controlnet is not None
    files = read_base_model_files(folder, controlnet=controlnet, with_controlnet=wanted)
    if needs_controlnet and "controlnet" not in files.parts:
        raise DataError(f"{folder}: no subfolder 'controlnet', and no separate ControlNet folder or file was given")
    return folder


def base_model_places(
    base_model: Path | None, *, controlnet: Path | None = None, needs_controlnet: bool = False
) -> list[Path]:
    """The folders and files that a base model consists of, after `check_base_model_folder`: what a cache key must
    contain.

    Args:
        base_model: None for the bundled one.
        controlnet: as for `find_controlnet`; None also stands for the base model's own.
        needs_controlnet: as for `check_base_model_folder`.
    """
    path = check_base_model_folder(
        base_model or BUNDLED_BASE_MODEL, controlnet=controlnet, needs_controlnet=needs_controlnet
    )
    chosen = [path] if controlnet is None else [path, find_controlnet(path, controlnet)]
    places = []
    for place in chosen:
        if place is not None:
            places += [place, *files_beside(place)] if place.is_file() else [place]
    return list(dict.fromkeys(places))


def learned_autoencoder(base_model: Path) -> list[Path] | None:
    """Folder or files of a learned autoencoder; None where it is the patch code, which costs next to nothing."""
    if read_parts(base_model).parts["vae"].config.get("_class_name") == "PatchAutoencoder":
        return None
    return [base_model, *files_beside(base_model)] if base_model.is_file() else [base_model / "vae"]


def find_controlnet(folder: Path, controlnet: Path | None) -> Path | None:
    """The ControlNet that is asked for, else the subfolder `controlnet` of the base model, else None.

    Args:
        folder: the base model.
        controlnet: name of a subfolder of the base model, such as `controlnet_normals`, or a diffusers folder or single
            file elsewhere.
    Raises:
        DataError: there is no such folder or file.
    """
    if controlnet is None:
        inside = folder / "controlnet"
        return inside if inside.is_dir() else None
    if len(controlnet.parts) == 1 and (folder / controlnet).is_dir():
        return folder / controlnet
    if controlnet.exists():
        return controlnet
    inside = ", ".join(sorted(path.name for path in folder.glob("controlnet*"))) if folder.is_dir() else ""
    raise DataError(
        f"{controlnet}: the ControlNet must be a diffusers folder or a checkpoint in one file, but there is no such "
        f"folder; those of the base model: {inside or 'none'}"
    )


def read_controlnet(path: Path) -> ModelPart:
    """Config and tensor table of a ControlNet's folder or file."""
    return read_single_controlnet(path) if path.is_file() else read_part("controlnet", path)


def _read_transformer_folder(folder: Path) -> ModelFiles:
    """Stable Diffusion 3's; T5, the third text encoder, may be left out, as in diffusers."""
    network = read_part("unet", folder / "transformer")
    check_transformer_class(network)
    missing = [name for name in TRANSFORMER_COMPONENTS if not (folder / name).is_dir()]
    if missing:
        raise DataError(f"{folder}: it has a transformer, as Stable Diffusion 3; missing: {', '.join(missing)}")
    names, has_t5 = ["text_encoder", "text_encoder_2", "vae"], (folder / "text_encoder_3").is_dir()
    if has_t5:
        names.append("text_encoder_3")
        if not (folder / "tokenizer_3").is_dir():
            raise DataError(f"{folder}: it has text_encoder_3, a T5 encoder; its tokenizer_3 is missing")
    return ModelFiles(
        place=folder,
        parts={"unet": network} | {name: read_part(name, folder / name) for name in names},
        tokenizer=folder / "tokenizer",
        scheduler_config=read_json(folder / "scheduler" / "scheduler_config.json"),
        tokenizer_2=folder / "tokenizer_2",
        tokenizer_3=folder / "tokenizer_3" if has_t5 else None,
    )


def _read_folder(folder: Path) -> ModelFiles:
    if (folder / "transformer").is_dir():
        return _read_transformer_folder(folder)
    missing = [name for name in COMPONENTS if not (folder / name).is_dir()]
    if missing:
        found = sorted(path.name for path in folder.iterdir() if path.is_dir())
        if "snapshots" in found:
            raise DataError(
                f"{folder}: a cache of Hugging Face's hub; give the folder of one revision in its snapshots"
            )
        raise DataError(
            f"{folder}: a diffusers folder has the subfolders {', '.join(COMPONENTS)}; "
            f"missing: {', '.join(missing)}; found: {', '.join(found) or 'none'}"
        )
    names, is_xl = ["text_encoder", "vae", "unet"], (folder / "text_encoder_2").is_dir()
    if is_xl:
        names.append("text_encoder_2")
        if not (folder / "tokenizer_2").is_dir():
            raise DataError(f"{folder}: it has text_encoder_2, as Stable Diffusion XL; its tokenizer_2 is missing")
    index = folder / "model_index.json"
    told = read_json(index) if is_xl and index.is_file() else {}
    return ModelFiles(
        place=folder,
        parts={name: read_part(name, folder / name) for name in names},
        tokenizer=folder / "tokenizer",
        scheduler_config=read_json(folder / "scheduler" / "scheduler_config.json"),
        tokenizer_2=folder / "tokenizer_2" if is_xl else None,
        zero_empty_prompt=bool(told.get(ZERO_EMPTY_PROMPT, is_xl)),
    )
