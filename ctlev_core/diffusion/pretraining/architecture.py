"""The architecture of the bundled small base model: Stable Diffusion's parts, three hundred times smaller.

Sizes were chosen on a two-core machine, by the time of a training step (ms an image, one core): widths (64, 96, 128)
with attention at the two lower resolutions 26, at the lowest alone 20; widths (64, 64, 96) 16; (48, 64, 96) 12, but 48
noisy latent channels leave a trunk of 48 no room. Heads have 32 channels: with 8 the same attention takes half as long
again.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import torch

from ctlev_core.diffusion.patch_autoencoder import PatchAutoencoder
from ctlev_core.diffusion.pretrained.loading import PretrainedModel
from ctlev_core.diffusion.pretrained.model_kinds import is_transformer

IMAGE_SIZE = 64
WIDTHS = (64, 64, 96)
HEAD_CHANNELS = 32
NORM_GROUPS = 16
TEXT_CHANNELS = 64
MAX_TOKENS = 24
VOCABULARY = 1536
CONDITION_WIDTHS = (16, 32, 64)  # the last of them, one more than conditions are halved on their way to latents

# The noise schedule of Stable Diffusion v1.4, but with beta_end 0.02 instead of 0.012. There the last step keeps 7 % of
# the signal's amplitude, enough to read the brightness of the whole picture from 48 x 256 latents; sampling, which
# starts from pure noise, would always begin half grey and leave a fog over black event images. Here 1.5 % remain.
SCHEDULER_CONFIG = {
    "_class_name": "DDPMScheduler",
    "num_train_timesteps": 1000,
    "beta_start": 0.00085,
    "beta_end": 0.02,
    "beta_schedule": "scaled_linear",
    "prediction_type": "v_prediction",
    "clip_sample": False,
    "steps_offset": 1,
}
PredictionType = Literal["v_prediction", "sample"]
"""What the U-Net predicts: v, or the latents themselves.

Noise fills all 48 channels of every latent, pictures only a few directions of them. A trunk of 64 channels that must
give the noise back, as v asks, leaves grain in its samples; one that gives the latents leaves clean surfaces (Li and
He, "Back to basics: let denoising generative models denoise", 2025). v is better where hardly any noise is left.
"""
WORD_GAIN = 12.0
"""How loud the mean of a prompt's words is beside a single word; 24 tokens share the mean, a handful are words."""
START, END = "<|startoftext|>", "<|endoftext|>"


def learn_merges(counts: Mapping[str, int], limit: int) -> list[tuple[str, str]]:
    """Merges of byte-pair encoding, the most frequent pair first, the first in the alphabet where several are.

    The trainer of `tokenizers` chooses at random among equally frequent pairs; words would have other numbers, and so
    other embeddings, in each run and in each of several processes.

    Args:
        counts: how often each word is seen; its last letter is told apart, as `t</w>`.
        limit: of the merges; there are fewer where no word is left in pieces.
    """
    pieces = {word: [*word[:-1], f"{word[-1]}</w>"] for word in sorted(counts)}
    merges: list[tuple[str, str]] = []
    while len(merges) < limit:
        frequency: Counter[tuple[str, str]] = Counter()
        for word, parts in pieces.items():
            for pair in pairwise(parts):
                frequency[pair] += counts[word]
        if not frequency:
            break
        first, second = best = min(frequency, key=lambda pair: (-frequency[pair], pair))
        merges.append(best)
        for parts in pieces.values():
            at = 0
            while at < len(parts) - 1:
                if (parts[at], parts[at + 1]) == best:
                    parts[at : at + 2] = [first + second]
                at += 1
    return merges


def train_tokenizer(corpus: Sequence[str], folder: Path) -> Any:
    """Train CLIP's byte-pair encoding on captions.

    Ids follow CLIP: 256 bytes, 256 bytes that end a word, merges, start, end. The end token must have the largest id,
    because CLIP's pooling looks for it by argmax.

    Args:
        corpus: captions; a word seen often enough becomes one token, unseen words fall back to pieces and bytes.
        folder: where `vocab.json` and `merges.txt` go.
    Returns:
        A `CLIPTokenizer`.
    """
    from tokenizers import Regex, normalizers, pre_tokenizers
    from transformers import CLIPTokenizer

    normalizer = normalizers.Sequence(
        [normalizers.NFC(), normalizers.Replace(Regex(r"\s+"), " "), normalizers.Lowercase()]
    )
    words = r"""'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"""
    splitter = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(words), behavior="removed", invert=True),
            pre_tokenizers.ByteLevel(add_prefix_space=False),
        ]
    )
    counts = Counter(
        word for caption in corpus for word, _ in splitter.pre_tokenize_str(normalizer.normalize_str(caption))
    )
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    pairs = learn_merges(counts, VOCABULARY - 2 * len(alphabet) - 2)
    vocabulary: dict[str, int] = {}
    pieces = [*alphabet, *(byte + "</w>" for byte in alphabet), *(a + b for a, b in pairs), START, END]
    for piece in pieces:
        vocabulary.setdefault(piece, len(vocabulary))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vocab.json").write_text(json.dumps(vocabulary, ensure_ascii=False))
    (folder / "merges.txt").write_text("#version: 0.2\n" + "".join(f"{a} {b}\n" for a, b in pairs))
    special = {"bos_token": START, "eos_token": END, "unk_token": END, "pad_token": END}
    settings = {"tokenizer_class": "CLIPTokenizer", "model_max_length": MAX_TOKENS, "do_lower_case": True, **special}
    (folder / "tokenizer_config.json").write_text(json.dumps(settings))
    return CLIPTokenizer.from_pretrained(str(folder))


def build_base_model(
    corpus: Sequence[str],
    vae: PatchAutoencoder,
    *,
    seed: int,
    widths: tuple[int, ...] = WIDTHS,
    image_size: int = IMAGE_SIZE,
    prediction_type: PredictionType = "v_prediction",
) -> PretrainedModel:
    """A base model with random weights.

    Args:
        corpus: captions the tokenizer is trained on.
        vae: the fitted patch code.
        seed: of the initial weights.
        widths: channels of the U-Net from the top to the bottom resolution; multiples of `NORM_GROUPS`, better of
            `HEAD_CHANNELS`.
        image_size: px, a multiple of 16.
        prediction_type: what the U-Net learns to predict: v, or `sample`, the latents themselves.
    """
    from diffusers.models.controlnets.controlnet import ControlNetModel
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    with tempfile.TemporaryDirectory() as folder:
        tokenizer = train_tokenizer(corpus, Path(folder))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        text_encoder = CLIPTextModel(
            CLIPTextConfig(
                vocab_size=len(tokenizer),
                hidden_size=TEXT_CHANNELS,
                intermediate_size=2 * TEXT_CHANNELS,
                projection_dim=TEXT_CHANNELS,
                num_hidden_layers=1,
                num_attention_heads=TEXT_CHANNELS // HEAD_CHANNELS,
                max_position_embeddings=MAX_TOKENS,
                bos_token_id=tokenizer.bos_token_id,
                eos_token_id=tokenizer.eos_token_id,
                pad_token_id=tokenizer.pad_token_id,
            )
        )
        fix_text_encoder(text_encoder, tokenizer)
        upper = len(widths) - 1  # a condition image says where; attention is needed at the lowest resolution only
        unet = UNet2DConditionModel(
            sample_size=image_size // vae.patch_px,
            in_channels=vae.config["latent_channels"],
            out_channels=vae.config["latent_channels"],
            block_out_channels=widths,
            layers_per_block=1,
            down_block_types=(*("DownBlock2D",) * upper, "CrossAttnDownBlock2D"),
            up_block_types=("CrossAttnUpBlock2D", *("UpBlock2D",) * upper),
            cross_attention_dim=TEXT_CHANNELS,
            # diffusers takes this as the number of heads, not as their size.
            attention_head_dim=tuple(max(1, width // HEAD_CHANNELS) for width in widths),  # pyright: ignore
            norm_num_groups=NORM_GROUPS,
            resnet_time_scale_shift="scale_shift",  # Dhariwal and Nichol, 2021: adaptive group normalisation
            # The pooled prompt also joins the time embedding: a tiny network learns cross-attention too slowly.
            addition_embed_type="text",
            addition_embed_type_num_heads=TEXT_CHANNELS // HEAD_CHANNELS,
        )
        controlnet = ControlNetModel.from_unet(
            unet, conditioning_embedding_out_channels=CONDITION_WIDTHS[-vae.patch_px.bit_length() :]
        )
        break_zeros(controlnet)
    scheduler_config = {**SCHEDULER_CONFIG, "prediction_type": prediction_type}
    return PretrainedModel(tokenizer, text_encoder, vae, unet, controlnet, scheduler_config, (image_size, image_size))


@torch.no_grad()
def fix_text_encoder(text_encoder: Any, tokenizer: Any) -> None:
    """Weights under which every token holds its word and the mean of the words up to it; they are never trained.

    Trained together with the U-Net, the text encoder collapsed: a small network finds the condition image first, has
    little to gain from prompts for a long time, and lets them grow alike. Fixed embeddings cannot; the U-Net learns
    what each of them means. Here every word has a random direction of unit variance. All scores of the first layer's
    attention are equal, so that it averages what came before, turned at random to be told from the word itself; start
    and end are left out of the average. Padding, most of a prompt, thus repeats what the whole prompt says, and the
    pooled prompt is a bag of its words (Arora et al., ICLR 2017) before the U-Net has learnt to look for them. Order
    stays in the words: a word's token holds the words before it, and not those after it. The other layers add nothing.

    Args:
        text_encoder: a `CLIPTextModel`; changed in place, with torch's global random stream.
        tokenizer: whose start and end tokens are not words.
    """
    words, positions = text_encoder.embeddings.token_embedding, text_encoder.embeddings.position_embedding
    width = words.embedding_dim
    marks = torch.linalg.qr(torch.randn(width, 2)).Q.T  # directions of start and end
    without_marks = torch.eye(width) - marks.T @ marks
    directions = torch.randn(words.weight.shape) @ without_marks
    words.weight.copy_(directions / directions.square().mean(dim=1, keepdim=True).sqrt())
    words.weight[[tokenizer.bos_token_id, tokenizer.eos_token_id]] = marks * width**0.5
    torch.nn.init.normal_(positions.weight, std=0.1)
    for parameter in text_encoder.encoder.layers.parameters():
        parameter.zero_()
    first = text_encoder.encoder.layers[0]
    first.layer_norm1.weight.fill_(1.0)
    first.self_attn.v_proj.weight.copy_(without_marks)
    first.self_attn.out_proj.weight.copy_(WORD_GAIN * torch.linalg.qr(torch.randn(width, width)).Q)


def break_zeros(controlnet: Any) -> None:
    """Small random weights where ControlNet starts at zero.

    Zero convolutions protect a trained U-Net. Here both are trained from the start, and zeros would only delay the
    moment when the condition is first used ("sudden convergence") by thousands of steps.
    """
    if is_transformer(controlnet):
        for layer in controlnet.controlnet_blocks:
            torch.nn.init.normal_(layer.weight, std=0.3 / layer.in_features**0.5)
        patches = controlnet.pos_embed_input.proj
        torch.nn.init.normal_(patches.weight, std=1.0 / patches.weight[0].numel() ** 0.5)
        return
    zero_convolutions = [*controlnet.controlnet_down_blocks, controlnet.controlnet_mid_block]
    for convolution in zero_convolutions:
        torch.nn.init.normal_(convolution.weight, std=0.3 / convolution.in_channels**0.5)
    output = controlnet.controlnet_cond_embedding.conv_out
    torch.nn.init.normal_(output.weight, std=1.0 / (9 * output.in_channels) ** 0.5)
