"""Networks whose weights are shared out over the processes that train them: fully sharded data parallelism, FSDP.

Every process holds its part of each weight, with the gradient, the moments and the average of that part, and has the
whole weights of a block only while it computes it. Whole weights are put together where something is written.

Source: Zhao et al., PyTorch FSDP, VLDB 2023; torch.distributed.fsdp.fully_shard.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributed.tensor import DTensor, distribute_tensor

from ctlev_core.diffusion.pretrained.loading import PretrainedModel

BLOCKS = ("down_blocks", "mid_block", "up_blocks", "controlnet_cond_embedding", "transformer_blocks")
"""Parts of a network whose weights are put together at a time; what is left is one part more."""


def shard_networks(base_model: PretrainedModel) -> None:
    """Leave this process its part of the weights of U-Net and ControlNet, in place; gradients are summed over all."""
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import FSDPModule, fully_shard

    mesh = init_device_mesh(base_model.unet.device.type, (torch.distributed.get_world_size(),))
    for network in filter(None, (base_model.unet, base_model.controlnet)):
        parts = [getattr(network, name, None) for name in BLOCKS]
        for part in filter(None, parts):
            for block in part if isinstance(part, torch.nn.ModuleList) else [part]:
                fully_shard(block, mesh=mesh, reshard_after_forward=True)
        # Nothing stays whole after a forward pass: weights change between passes without gradients, too.
        fully_shard(network, mesh=mesh, reshard_after_forward=True)
        for module in network.modules():
            if isinstance(module, FSDPModule):
                module.set_gradient_divide_factor(1.0)
                module.set_force_sum_reduction_for_comms(True)  # a factor in the message itself NCCL alone knows


def gather_networks(base_model: PretrainedModel, *, keep: bool) -> PretrainedModel | None:
    """The base model with whole, plain networks in CPU memory; all processes take part, those that `keep` get it."""
    plain: dict[str, Any] = {}
    for name in ("unet", "controlnet"):
        network = getattr(base_model, name)
        if network is None:
            continue
        weights = whole(network.state_dict(), keep=keep)
        if keep:
            plain[name] = type(network).from_config(network.config)
            plain[name].load_state_dict(weights)
            plain[name].eval().requires_grad_(False)
    return replace(base_model, **plain) if keep else None


@torch.no_grad()
def whole(tree: Any, *, keep: bool = True) -> Any:
    """Nested dicts and lists with every tensor whole, in CPU memory where it was shared out.

    All processes must ask for the same; those that do not `keep` it get None in the place of shared-out tensors.
    """
    if isinstance(tree, DTensor):
        full = tree.full_tensor()
        return full.cpu() if keep else None
    if isinstance(tree, Mapping):
        return {key: whole(value, keep=keep) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(whole(value, keep=keep) for value in tree)
    return tree


def part_of(full: Tensor, like: Tensor) -> Tensor:
    """Of a whole tensor this process's part, shared out as `like` is; the tensor itself where that is whole."""
    if not isinstance(like, DTensor):
        return full
    return distribute_tensor(full.to(like.device), like.device_mesh, like.placements, src_data_rank=None)


def part_of_optimizer(state: dict[str, Any], parameters: Sequence[Tensor]) -> dict[str, Any]:
    """An optimiser's state dict with the moments of each weight shared out as the weight is."""

    def shared(value: Any, parameter: Tensor) -> Any:
        alike = isinstance(value, Tensor) and value.shape == parameter.shape
        return part_of(value, parameter) if alike else value

    entries = {
        index: {name: shared(value, parameters[index]) for name, value in entry.items()}
        for index, entry in state["state"].items()
    }
    return {**state, "state": entries}
