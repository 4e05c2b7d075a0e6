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
        checkpoint: a diffusers pipeline folder; its parts `tokenizer` and `text_encoder` are read, and no other.
        names: N texts.
    """
    import torch
    from transformers import CLIPTextModel, CLIPTokenizer

    tokenizer = CLIPTokenizer.from_pretrained(checkpoint / "tokenizer", local_files_only=True)
    encoder = CLIPTextModel.from_pretrained(checkpoint / "text_encoder", local_files_only=True, use_safetensors=True)
    tokens = tokenizer(list(names), padding="max_length", truncation=True, return_tensors="pt")
    with torch.no_grad():
        return encoder.float().eval()(tokens.input_ids).pooler_output.numpy()
