"""Weights shared out over processes: who holds what, and the way back to whole ones."""

from __future__ import annotations

import pytest
import torch
from tiny_base_model import make_base_model

from ctlev_core.diffusion.training.fsdp import gather_networks, part_of, part_of_optimizer, shard_networks, whole

PROCESSES = 2


def share_out(rank, folder):
    """The main program of each process: share out a base model, put it together again, and tell what was held."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=PROCESSES
    )
    base_model = make_base_model()
    before = {name: dict(getattr(base_model, name).state_dict()) for name in ("unet", "controlnet")}
    before = {name: {key: value.clone() for key, value in state.items()} for name, state in before.items()}
    shard_networks(base_model)
    held = {name: sum(p.to_local().numel() for p in getattr(base_model, name).parameters()) for name in before}
    of = {name: sum(value.numel() for value in state.values()) for name, state in before.items()}
    gathered = gather_networks(base_model, keep=rank == 0)
    assert (gathered is None) == (rank != 0)
    same = gathered is None or all(
        torch.equal(value, before[name][key])
        for name in before
        for key, value in getattr(gathered, name).state_dict().items()
    )
    torch.save({"held": held, "of": of, "same": same}, f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_a_process_holds_its_part_and_parts_make_the_whole(tmp_path):
    torch.multiprocessing.spawn(share_out, args=(str(tmp_path),), nprocs=PROCESSES)
    told = [torch.load(tmp_path / f"{rank}.pt") for rank in range(PROCESSES)]
    for name in ("unet", "controlnet"):
        assert sum(each["held"][name] for each in told) == told[0]["of"][name]
        # Weights are cut along their first axis, so that what has an odd number of rows is not halved.
        assert max(each["held"][name] for each in told) < 0.52 * told[0]["of"][name]
    assert all(each["same"] for each in told)


def test_whole_tensors_pass_through():
    weight = torch.nn.Parameter(torch.arange(6.0).reshape(2, 3))
    tree = {"a": [weight, 3], "b": (None, "text")}
    passed = whole(tree)
    assert passed["a"][0] is weight and passed["a"][1] == 3 and passed["b"] == (None, "text")
    assert part_of(weight.detach(), weight).equal(weight)
    optimizer = torch.optim.AdamW([weight])
    weight.sum().backward()
    optimizer.step()
    state = optimizer.state_dict()
    shared = part_of_optimizer(state, [weight])
    assert shared["param_groups"] == state["param_groups"]
    for name, value in state["state"][0].items():
        assert shared["state"][0][name] is value, name


@pytest.mark.parametrize("keep", [True, False])
def test_what_is_not_shared_out_is_everyones(keep):
    assert whole({"x": torch.ones(2)}, keep=keep)["x"].equal(torch.ones(2))
