"""Prompts as U-Nets and ControlNets take them.

Stable Diffusion v1 and 2 take the last layer of a text encoder, [L, D] for a prompt. Stable Diffusion XL takes the last
layer but one of two text encoders side by side, the pooled embedding of the second, and six sizes in px. The latter
follow the L rows here, in rows of the same width filled up with zeros: what is cached, drawn and moved is one tensor
for every base model. Stable Diffusion 3 takes the rows of two CLIP encoders side by side, filled up to the width of T5,
below them the rows of T5, and both pooled embeddings; without T5, which may be left out, zeros.

Source: Podell et al., SDXL, 2023, sections 2.1 and 2.2; diffusers' `StableDiffusionXLPipeline` and
`StableDiffusion3Pipeline`. Sizes are those of the
images, which are never cropped: the original and the target size are the same.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ctlev_core.diffusion.pretrained.checks import NUM_SIZES
from ctlev_core.diffusion.pretrained.model_kinds import is_transformer

if TYPE_CHECKING:
    from ctlev_core.diffusion.pretrained.loading import PretrainedModel

PROMPT_BATCH = 128
"""Prompts that go through a text encoder at once: 3 MB each with Stable Diffusion's, and there may be thousands."""
T5_TOKENS = 256
"""Length that prompts are padded or cut to for T5; diffusers' pipeline takes as many."""
logger = logging.getLogger(__name__)


def encode_prompts(base_model: PretrainedModel, prompts: list[str]) -> Tensor:
    """Prompt embeddings [N, L, D], of Stable Diffusion XL and 3 [N, L + R, D]; see the head of this file.

    L is the length every prompt is padded or cut to. A cut prompt is logged.
    """
    limit = base_model.tokenizer.model_max_length
    if base_model.text_encoder_2 is None or base_model.tokenizer_2 is None:
        return _encode(base_model.tokenizer, base_model.text_encoder, prompts, limit)[0]
    limit = min(limit, base_model.tokenizer_2.model_max_length)
    first, pooled_first = _encode(base_model.tokenizer, base_model.text_encoder, prompts, limit, last_but_one=True)
    second, pooled = _encode(base_model.tokenizer_2, base_model.text_encoder_2, prompts, limit, last_but_one=True)
    hidden = torch.cat([first, second], dim=-1)
    if is_transformer(base_model.unet):
        hidden = torch.cat([_widened(hidden, base_model.unet), _of_t5(base_model, prompts)], dim=1)
        return _with_rows(hidden, torch.cat([pooled_first, pooled], dim=-1))
    if base_model.zero_empty_prompt:
        said = torch.tensor([bool(prompt) for prompt in prompts], device=hidden.device)
        hidden, pooled = hidden * said[:, None, None], pooled * said[:, None]
    width, height = base_model.image_size
    sizes = torch.tensor([height, width, 0, 0, height, width]).to(pooled).expand(len(prompts), -1)
    return _with_rows(hidden, torch.cat([pooled, sizes], dim=-1))


def _with_rows(hidden: Tensor, further: Tensor) -> Tensor:
    """[N, L, D], and below it vectors [N, F] in rows of width D."""
    further = torch.nn.functional.pad(further, (0, -further.shape[-1] % hidden.shape[-1]))
    return torch.cat([hidden, further.view(len(hidden), -1, hidden.shape[-1])], dim=1)


def _widened(hidden: Tensor, transformer: Any) -> Tensor:
    return torch.nn.functional.pad(hidden, (0, transformer.config.joint_attention_dim - hidden.shape[-1]))


def _of_t5(base_model: PretrainedModel, prompts: list[str]) -> Tensor:
    """Embeddings [N, L, D] of T5; without it zeros, as in diffusers."""
    if base_model.text_encoder_3 is None or base_model.tokenizer_3 is None:
        width, like = base_model.unet.config.joint_attention_dim, next(base_model.text_encoder.parameters())
        return torch.zeros((len(prompts), T5_TOKENS, width), dtype=like.dtype, device=like.device)
    return _encode(base_model.tokenizer_3, base_model.text_encoder_3, prompts, T5_TOKENS)[0]


def prompt_arguments(network: Any, embeddings: Tensor) -> dict[str, Any]:
    """What a U-Net, or a ControlNet of it, is called with for embeddings of `encode_prompts`.

    Args:
        network: the U-Net or transformer.
        embeddings: [B, L, D], of Stable Diffusion XL and 3 [B, L + R, D].
    """
    further = num_further_values(network)
    if further == 0:
        return {"encoder_hidden_states": embeddings}
    rows = -(-further // embeddings.shape[-1])
    tokens, pooled = embeddings[:, :-rows], embeddings[:, -rows:].flatten(1)[:, :further]
    if is_transformer(network):
        return {"encoder_hidden_states": tokens, "pooled_projections": pooled}
    pooled, sizes = pooled.split([further - NUM_SIZES, NUM_SIZES], dim=1)
    return {"encoder_hidden_states": tokens, "added_cond_kwargs": {"text_embeds": pooled, "time_ids": sizes}}


def num_further_values(network: Any) -> int:
    """How many values follow the embeddings of tokens: a pooled embedding, for Stable Diffusion XL also image sizes."""
    config = getattr(network, "config", None)
    if is_transformer(network):
        return int(network.config.pooled_projection_dim)
    if config is None or config.get("addition_embed_type") != "text_time":
        return 0
    return int(config["projection_class_embeddings_input_dim"] - NUM_SIZES * (config["addition_time_embed_dim"] - 1))


def put_text_encoders_aside(base_model: PretrainedModel) -> None:
    """To the memory of the CPU: prompts are embedded, and the networks need the card's."""
    encoders = (base_model.text_encoder, base_model.text_encoder_2, base_model.text_encoder_3)
    for encoder in filter(None, encoders):
        encoder.to("cpu")


@torch.no_grad()
def _encode(
    tokenizer: Any, encoder: Any, prompts: list[str], limit: int, *, last_but_one: bool = False
) -> tuple[Tensor, Tensor]:
    """Embeddings [N, L, D] of a text encoder's last layer, or that before it, and what else it says first."""
    tokens = tokenizer(
        prompts, padding="max_length", max_length=limit, truncation=True, return_tensors="pt", verbose=False
    )
    for row in tokens.attention_mask.all(dim=1).nonzero().flatten().tolist():  # no padding: perhaps it did not fit
        length = len(tokenizer(prompts[row], verbose=False).input_ids)
        if length > limit:
            logger.warning("prompt of %d tokens is cut to %d, its end is not heeded: %r", length, limit, prompts[row])
    hidden, firsts = [], []
    for ids in tokens.input_ids.split(PROMPT_BATCH):
        made = encoder(ids.to(encoder.device), output_hidden_states=last_but_one)
        firsts.append(made[0])
        hidden.append(made.hidden_states[-2] if last_but_one else made[0])
    return torch.cat(hidden), torch.cat(firsts)
