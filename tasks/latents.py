"""Encode recorded frames by a frozen autoencoder, once for all trainings that start from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.diffusion.pretrained.paths import learned_autoencoder
from ctlev_core.diffusion.training.options import LatentOptions
from data_contracts import tables
from data_contracts.errors import DataError
from data_contracts.file_lists import files_of
from data_contracts.manifest import Manifest
from tasks.stage import Output, stage


def _autoencoder_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    options: LatentOptions = arguments["latents"]
    return files_of(learned_autoencoder(options.base_model) or [options.base_model / "vae"])


@stage(version=2, schema=tables.LATENTS, raw_files=_autoencoder_files)
def encode_latents(out: Output, frames: Manifest, *, latents: LatentOptions) -> pa.Table:
    """Means and standard deviations of the latents of every training frame, and of its quarter turns.

    They are stored in float32, as a training would have them, in files `mean_NNNN.npy` and `std_NNNN.npy`, whose rows,
    one file after another, are those of the table. A run that was killed goes on with the file that it was at.

    Raises:
        DataError: there is no training frame, frames are not of the base model's size, or latents are not finite.
    """
    from ctlev_core.diffusion.pretrained.fit import check_image_size
    from ctlev_core.diffusion.pretrained.loading import choose_device, load_autoencoder
    from ctlev_core.diffusion.training.latent_files import write_latent_files

    rows = frames.rows_where(split="train")
    if not len(rows):
        raise DataError(f"{frames.ref.path}: no rows in split 'train' to encode")
    images = frames.images(rows)
    check_image_size(latents.base_model, (images.shape[2], images.shape[1]))
    vae = load_autoencoder(latents.base_model, choose_device(latents.device))
    names = np.array(frames.column("sample_id"))[rows]
    sample_ids, turns = [], []
    for number, (own, files) in enumerate(write_latent_files(vae, images, latents.num_turns, out.work)):
        for kind, path in files.items():
            out.share(path, f"{kind}_{number:04d}.npy")
        sample_ids.append(np.tile(names[own.start : own.stop], latents.num_turns))
        turns.append(np.repeat(np.arange(latents.num_turns, dtype=np.int32), len(own)))
    return pa.table(
        {"sample_id": pa.array(np.concatenate(sample_ids).tolist()), "quarter_turns": pa.array(np.concatenate(turns))}
    )
