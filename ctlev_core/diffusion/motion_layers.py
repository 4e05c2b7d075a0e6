"""Layers that make the frames of a stretch from one another, in an image U-Net that stays as it is.

The layers are diffusers' `MotionAdapter`: after every layer of the U-Net (its residual block, or the attention behind
it) each pixel attends to itself in the other frames of its stretch. Around them each frame is computed by itself, by
the U-Net and the ControlNet of the image generator. Without a stretch (`lengths` None) the layers do nothing.

Stretches longer than `context` frames are attended to in windows of so many frames that overlap by half; where windows
overlap their outputs are averaged, with the weights of a pyramid.

Source: Guo et al., AnimateDiff, ICLR 2024 (motion module, zero-initialised, only it learns); windows as in Qiu et al.,
FreeNoise, ICLR 2024. Unlike diffusers' `UNetMotionModel` the layers hang on the forward hooks of any
`UNet2DConditionModel`, also of those whose time embedding scales and shifts, as that of the small base model; of
Stable Diffusion v1 both compute the same. The folder `motion_adapter/` of a checkpoint is diffusers' own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ctlev_core.diffusion.motion_files import MAX_CONTEXT, MOTION_FOLDER, MotionSettings, read_settings, write_settings
from data_contracts.errors import DataError

CHANNELS_A_HEAD = 32
MAX_HEADS = 8


class MotionLayers:
    """A motion adapter at work in a U-Net.

    Attributes:
        adapter: diffusers' `MotionAdapter`, on the device and in the precision of the U-Net.
        settings: what it learnt.
        lengths: frames of each stretch of the batch, which lie behind one another; None = each frame is by itself.
    """

    def __init__(self, unet: Any, adapter: Any, settings: MotionSettings) -> None:
        """Hang the layers on the U-Net's forward hooks."""
        self.adapter, self.settings = adapter, settings
        self.lengths: Sequence[int] | None = None
        for layer, module in _pairs(unet, adapter):
            layer.register_forward_hook(_Hook(self, module))

    @contextmanager
    def of(self, lengths: Sequence[int] | None) -> Iterator[None]:
        """Within the context batches hold stretches of so many frames; with guidance all of them twice."""
        before, self.lengths = self.lengths, lengths
        try:
            yield
        finally:
            self.lengths = before

    def apply(self, module: Any, hidden: Tensor) -> Tensor:
        """One layer's states [B, C, h, w] after its motion module."""
        if self.lengths is None:
            return hidden
        total = sum(self.lengths)
        if total == 0 or len(hidden) % total:
            raise ValueError(f"stretches of {total} frames in all are not a batch of {len(hidden)}")
        lengths = [*self.lengths] * (len(hidden) // total)
        if len(set(lengths)) == 1:
            return self._attend(module, hidden, lengths[0])
        return torch.cat([self._attend(module, part, len(part)) for part in hidden.split(lengths)])

    def _attend(self, module: Any, hidden: Tensor, length: int) -> Tensor:
        """Of stretches of equal length."""
        context = self.settings.context
        if length <= context:
            return module(hidden, num_frames=length)
        stretches = hidden.unflatten(0, (-1, length))
        total, weights = torch.zeros_like(stretches), hidden.new_zeros(length)
        of_window = pyramid(context).to(hidden)
        for start in window_starts(length, context):
            window = slice(start, start + context)
            made = module(stretches[:, window].flatten(0, 1), num_frames=context)
            total[:, window] += of_window[:, None, None, None] * made.unflatten(0, (-1, context))
            weights[window] += of_window
        return (total / weights[:, None, None, None]).flatten(0, 1)


class _Hook:
    """A forward hook; Transformers of diffusers return a tuple, residual blocks a tensor."""

    def __init__(self, layers: MotionLayers, module: Any) -> None:
        self._layers, self._module = layers, module

    def __call__(self, _: nn.Module, arguments: Any, output: Any) -> Any:
        if isinstance(output, tuple):
            return (self._layers.apply(self._module, output[0]), *output[1:])
        return self._layers.apply(self._module, output)


def window_starts(length: int, context: int) -> list[int]:
    """First frames of windows of `context` frames that overlap by half and cover `length` frames."""
    last = length - context
    return sorted({*range(0, last, max(context // 2, 1)), last})


def pyramid(context: int) -> Tensor:
    """Weights [context] of the frames of a window: 1, 2, ... to the middle and down again."""
    up = torch.arange(1, context + 1)
    return torch.minimum(up, up.flip(0))


def new_adapter(unet: Any, seed: int) -> Any:
    """A `MotionAdapter` that fits a U-Net, and changes nothing until it has learnt: its outputs start at 0."""
    from diffusers.models.unets.unet_motion_model import MotionAdapter

    config = unet.config
    channels = tuple(config.block_out_channels)
    heads: Any = tuple(map(_num_heads, channels))  # annotated there as a tuple of one
    layers = config.layers_per_block
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        adapter = MotionAdapter(
            block_out_channels=channels,
            motion_layers_per_block=layers if isinstance(layers, int) else tuple(layers),
            motion_num_attention_heads=heads,
            motion_norm_num_groups=config.norm_num_groups,
            motion_max_seq_length=MAX_CONTEXT,
            use_motion_mid_block=unet.mid_block is not None,
        )
    for _, module in _pairs(unet, adapter):
        nn.init.zeros_(module.proj_out.weight)
        nn.init.zeros_(module.proj_out.bias)
    return adapter.to(unet.device)


def _num_heads(width: int) -> int:
    """Heads of `CHANNELS_A_HEAD` channels, at most `MAX_HEADS`, which is what AnimateDiff has."""
    return max(n for n in range(1, MAX_HEADS + 1) if width % n == 0 and (n == 1 or width // n >= CHANNELS_A_HEAD))


def _pairs(unet: Any, adapter: Any) -> Iterator[tuple[nn.Module, Any]]:
    """The layers of a U-Net, and the motion module behind each, in the order of `UNetMotionModel`.

    Raises:
        DataError: they do not belong together.
    """
    blocks = [*zip(unet.down_blocks, adapter.down_blocks, strict=False)]
    blocks += [*zip(unet.up_blocks, adapter.up_blocks, strict=False)]
    if len(unet.down_blocks) != len(adapter.down_blocks):
        raise DataError(f"motion layers of {len(adapter.down_blocks)} blocks, in a U-Net of {len(unet.down_blocks)}")
    if unet.mid_block is not None and adapter.mid_block is not None:
        blocks.append((unet.mid_block, adapter.mid_block))
    for block, modules in blocks:
        layers = getattr(block, "attentions", None) or block.resnets
        if len(layers) != len(modules.motion_modules):
            raise DataError(
                f"{len(modules.motion_modules)} motion layers for a block of the U-Net that has {len(layers)} layers"
            )
        yield from zip(layers, modules.motion_modules, strict=True)


def save_motion_layers(layers: MotionLayers, checkpoint: Path) -> None:
    """Write the adapter into a checkpoint folder."""
    layers.adapter.save_pretrained(checkpoint / MOTION_FOLDER, safe_serialization=True)
    write_settings(checkpoint, layers.settings)


def load_motion_layers(checkpoint: Path, unet: Any) -> MotionLayers | None:
    """The motion layers of a checkpoint, at work in its U-Net; None where it has none.

    Raises:
        DataError: they are damaged, or of another U-Net.
    """
    from ctlev_core.diffusion.pretrained.components import read_json

    folder = checkpoint / MOTION_FOLDER
    if not folder.is_dir():
        return None
    settings, adapter = read_settings(checkpoint), new_adapter(unet, 0)
    config = read_json(folder / "config.json")
    for name in ("block_out_channels", "motion_layers_per_block", "motion_num_attention_heads"):
        expected = adapter.config[name]
        if json.dumps(config.get(name)) != json.dumps(expected):
            raise DataError(f"{folder}: {name} must be {expected} for this U-Net, got {config.get(name)}")
    _load_weights(adapter, folder)
    nn.Module.to(adapter, unet.device, unet.dtype)  # diffusers' own `to` warns of modules that there are not
    return MotionLayers(unet, adapter.eval().requires_grad_(False), settings)


def _load_weights(adapter: Any, folder: Path) -> None:
    from ctlev_core.diffusion.pretrained.components import weights_files
    from ctlev_core.diffusion.pretrained.model_building import load_tensor
    from ctlev_core.safe_files.tensor_files import read_tensor_table

    stored = {name: tensor for file in weights_files(folder) for name, tensor in read_tensor_table(file).items()}
    own = adapter.state_dict()
    missing = sorted(own.keys() - stored.keys())
    if missing:
        raise DataError(f"{folder}: weights are missing: {', '.join(missing[:3])}")
    loaded = {}
    for name, value in own.items():
        tensor = load_tensor(stored[name], torch.float32)
        if tensor.shape != value.shape:
            raise DataError(f"{folder}: {name} must be {list(value.shape)}, got {list(tensor.shape)}")
        loaded[name] = tensor
    adapter.load_state_dict(loaded)
