"""When networks are compiled, and which batches of sampling run compiled."""

import numpy as np
import pytest
import torch

from ctlev_core.diffusion import compilation
from ctlev_core.diffusion.compilation import compiler_works, pays
from ctlev_core.diffusion.sampling import sampling
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.out_of_memory import ShrinkingBatches
from data_contracts.labels import Conditions

CPU, GPU = torch.device("cpu"), torch.device("cuda", 1)


@pytest.mark.parametrize(
    ("asked", "device", "num_passes", "expected"),
    [
        ("auto", GPU, 3000, True),
        ("auto", GPU, 2999, False),
        ("auto", CPU, 10**9, False),
        (True, CPU, 1, True),
        (False, GPU, 10**9, False),
    ],
)
def test_auto_compiles_long_runs_on_a_gpu(asked, device, num_passes, expected):
    assert pays(asked, device, num_passes, 3000) is expected


def test_without_a_compiler_networks_run_as_they_are(monkeypatch, caplog):
    def none(*_, **__):
        raise RuntimeError("no C++ compiler was found")

    monkeypatch.setattr(torch, "compile", none)
    assert not compiler_works(CPU)
    assert "networks run uncompiled: no C++ compiler was found" in caplog.text


def test_batches_of_another_size_run_uncompiled_and_halved_ones_compiled(monkeypatch):
    stances = []
    monkeypatch.setattr(torch.compiler, "set_stance", lambda stance: stances.append(stance) or Nothing())
    batches = ShrinkingBatches(8)
    sample = lambda rows: stances.append(rows.stop - rows.start)  # noqa: E731
    for rows in (slice(0, 8), slice(8, 11)):
        sampling._compiled_if_whole(sample, batches, 8, rows)
    batches.size = 4  # memory ran out
    sampling._compiled_if_whole(sample, batches, 8, slice(0, 4))
    assert stances == ["default", 8, "force_eager", 3, "default", 4]


class Nothing:
    def __enter__(self):
        return None

    def __exit__(self, *_):
        return None


@pytest.mark.parametrize(("missing", "batch_size"), [(3, 2), (1, 2)])
def test_what_is_left_of_a_run_does_not_change_what_is_compiled(monkeypatch, missing, batch_size):
    """A run that goes on has fewer rows to sample and must give the frames of one that was not interrupted."""
    asked, handed = [], []
    monkeypatch.setattr(sampling, "load_for_sampling", lambda *_: FakeModel())
    monkeypatch.setattr(sampling, "_check_conditions", lambda *_: None)
    monkeypatch.setattr(sampling, "compiler_works", lambda device: True)
    monkeypatch.setattr(sampling, "pays", lambda how, device, passes, even: asked.append(passes) or True)
    monkeypatch.setattr(sampling, "compile_for_sampling", lambda model: None)
    monkeypatch.setattr(sampling, "sample_shards", lambda *arguments: handed.append(arguments[-1]))
    options = SamplingOptions(batch_size=batch_size, num_inference_steps=10)
    shards = [FakeShard() for _ in range(missing)]
    sampling._sample_share(None, options, False, [""], 5, "cpu", shards, lambda _: None)
    assert asked == [3 * 10] and handed == [2]


class FakeModel:
    class unet:
        device = CPU


class FakeShard:
    conditions, seeds = None, np.arange(1)


def test_nothing_heavy_is_imported():
    assert compilation.__dict__.get("torch") is None


def write_tiny(folder):
    from tiny_base_model import SIDE, make_base_model

    from ctlev_core.diffusion.pretrained.loading import save_base_model

    save_base_model(make_base_model(), folder)
    return SIDE


def write_transformer(folder):
    from tiny_families import write_family
    from tiny_stable_diffusion import SIDE

    write_family("sd3", folder)
    return SIDE


@pytest.mark.parametrize(
    "write",
    [pytest.param(write_tiny, marks=pytest.mark.slow), pytest.param(write_transformer, marks=pytest.mark.release)],
)
def test_compiled_networks_sample_the_same_frames(tmp_path, write):
    """For real: a minute or two on a CPU. Five frames in batches of two, of which the last one runs uncompiled."""
    side = write(tmp_path / "base_model")
    images = np.random.default_rng(4).integers(0, 256, (5, side, side, 3), np.uint8)
    conditions = Conditions(("a photo of a cup",) * 5, images)

    def sample(compiled):
        options = SamplingOptions(
            num_inference_steps=3, batch_size=2, black_threshold=0, device="cpu", compile_networks=compiled
        )
        return sampling.sample_checkpoint(
            tmp_path / "base_model",
            conditions,
            options,
            with_controlnet=True,
            seeds=range(5),
            work=tmp_path / str(compiled),
        ).astype(int)

    usual, compiled = sample(False), sample(True)
    assert usual.std() > 1 and np.abs(usual - compiled).max() <= 1
    assert np.array_equal(usual[4], compiled[4])
