"""Where the pre-trained weights lie, and whether they are all there. Imports nothing heavy: the plan calls it."""

from __future__ import annotations

from pathlib import Path

from data_contracts.errors import DataError

BUNDLED_PRIOR = Path(__file__).resolve().parents[1] / "priors" / "small"
COMPONENTS = ("tokenizer", "text_encoder", "vae", "unet", "scheduler")


def check_prior_folder(folder: Path, *, controlnet: Path | None = None, needs_controlnet: bool = False) -> Path:
    """Raise unless `folder` looks like a diffusers pipeline whose weights can be read.

    Args:
        folder: with the subfolders of `COMPONENTS`, and perhaps `controlnet`.
        controlnet: as for `find_controlnet`.
        needs_controlnet: raise where there is neither the subfolder nor the separate folder.
    Returns:
        The folder.
    Raises:
        DataError: what is missing, and where it was looked for.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: the prior must be a diffusers folder, but there is no such folder")
    missing = [name for name in COMPONENTS if not (folder / name).is_dir()]
    if missing:
        found = sorted(path.name for path in folder.iterdir() if path.is_dir())
        raise DataError(
            f"{folder}: a diffusers folder has the subfolders {', '.join(COMPONENTS)}; "
            f"missing: {', '.join(missing)}; found: {', '.join(found) or 'none'}"
        )
    control = find_controlnet(folder, controlnet)
    if needs_controlnet and control is None:
        raise DataError(f"{folder}: no subfolder 'controlnet', and no separate ControlNet folder was given")
    for part in [folder / name for name in ("text_encoder", "vae", "unet")] + ([control] if control else []):
        if not (part / "config.json").is_file():
            raise DataError(f"{part}: config.json is missing")
        if not list(part.glob("*.safetensors")):
            raise DataError(f"{part}: no .safetensors file; pickled weights (.bin, .ckpt) are not read")
    return folder


def find_controlnet(folder: Path, controlnet: Path | None) -> Path | None:
    """The ControlNet that is asked for, else the subfolder `controlnet` of the prior, else None.

    Args:
        folder: the prior.
        controlnet: name of a subfolder of the prior, such as `controlnet_normals`, or a folder elsewhere.
    Raises:
        DataError: there is no such folder.
    """
    if controlnet is not None and len(controlnet.parts) == 1 and (folder / controlnet).is_dir():
        return folder / controlnet
    if controlnet is not None:
        if not controlnet.is_dir():
            inside = ", ".join(sorted(path.name for path in folder.glob("controlnet*")))
            raise DataError(
                f"{controlnet}: the ControlNet must be a diffusers folder, but there is no such folder; "
                f"those of the prior: {inside or 'none'}"
            )
        return controlnet
    inside = folder / "controlnet"
    return inside if inside.is_dir() else None
