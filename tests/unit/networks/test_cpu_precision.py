"""bfloat16 is computed in float32 on processors without instructions for it, and nowhere else."""

import pytest
import torch

from ctlev_core import cpu_precision
from ctlev_core.cpu_precision import computed_in, names_bfloat16
from ctlev_core.diffusion.training.acceleration import autocast
from ctlev_core.diffusion.training.muon import orthogonalised
from ctlev_core.diffusion.training.options import TrainingOptions


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("processor\t: 0\nflags\t\t: fpu avx2 avx512f avx512_vnni\n", False),
        ("processor\t: 0\nflags\t\t: fpu avx512f avx512_bf16\n", True),
        ("processor\t: 0\nflags\t\t: fpu amx_bf16 amx_tile\n", True),
        ("processor\t: 0\nFeatures\t: fp asimd sve bf16\n", True),
        ("processor\t: 0\nFeatures\t: fp asimd\n", False),
        ("processor\t: 0\nmodel name\t: bf16\n", True),  # says nothing of instructions
        ("", True),
    ],
)
def test_what_the_system_says_of_instructions(text, expected):
    assert names_bfloat16(text) == expected


def test_only_bfloat16_on_such_a_cpu_is_replaced(monkeypatch):
    monkeypatch.setattr(cpu_precision, "has_bfloat16", lambda: False)
    found = {(name, place): computed_in(name, place) for name in ("float32", "bfloat16", "float16") for place in PLACES}
    assert found.pop(("bfloat16", "cpu")) == "float32"
    assert all(found[name, place] == name for name, place in found)
    monkeypatch.setattr(cpu_precision, "has_bfloat16", lambda: True)
    assert computed_in("bfloat16", "cpu") == "bfloat16"


PLACES = ("cpu", "cuda", "mps")


@pytest.mark.parametrize("native", [False, True])
def test_training_follows(monkeypatch, native):
    monkeypatch.setattr(cpu_precision, "has_bfloat16", lambda: native)
    matrix = torch.randn((8, 8), generator=torch.Generator().manual_seed(0))
    with autocast(TrainingOptions(precision="bfloat16"), torch.device("cpu")):
        product = matrix @ matrix
    assert product.dtype == (torch.bfloat16 if native else torch.float32)
    made = orthogonalised(matrix[None])
    assert torch.equal(made, made.bfloat16().float()) == native
    values = torch.linalg.svdvals(made[0])
    assert values[:-1].min() > 0.6 and values.max() < 1.3
