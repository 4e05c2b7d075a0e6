"""What a text encoder makes of names, as one vector each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def embed_names(checkpoint: Path, names: Sequence[str]) -> np.ndarray:
    """Pooled output [N, D] float32 of a checkpoint's text encoder, of each name by itself.

    The paper compares names in CLIP's feature space, which lies one linear layer further: Stable Diffusion's folders
    have CLIP's text encoder without it.

    Args:
        checkpoint: a diffusers pipeline folder, a checkpoint in one file, or an adapter, whose base model has the
            encoder; nothing but tokenizer and text encoder is loaded.
        names: N texts.
    Raises:
        DataError: they cannot be read.
    """
    import torch

    from ctlev_core.diffusion.pretrained.loading import load_text_encoder

    tokenizer, encoder = load_text_encoder(checkpoint)
    tokens = tokenizer(list(names), padding="max_length", truncation=True, return_tensors="pt")
    with torch.no_grad():
        return getattr(encoder, "text_model", encoder)(tokens.input_ids).pooler_output.numpy()
