"""The scatter of real values about expected ones: measured where it is known, and drawn with the same moments."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_base_model import SIDE, make_base_model, make_data

from ctlev_core.diffusion.pretrained.loading import images_to_tensor, save_base_model
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling import value_table
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import decode_frames, sample_checkpoint
from ctlev_core.diffusion.sampling.value_table import (
    draw_values,
    fit_value_table,
    nearest_values,
    read_value_table,
    write_value_table,
)
from ctlev_core.diffusion.training import finetuning
from ctlev_core.diffusion.training.finetuning import fine_tune
from ctlev_core.diffusion.training.latent_cache import cache_latents
from ctlev_core.diffusion.training.options import FineTuningOptions
from data_contracts.errors import DataError
from data_contracts.labels import Conditions


class Blind(torch.nn.Module):
    """Says the same latents whatever it is shown: what it expects is known."""

    def __init__(self, latents):
        super().__init__()
        self.latents = latents
        self.device = torch.device("cpu")

    def forward(self, noisy, timesteps, encoder_hidden_states):
        return type("Output", (), {"sample": self.latents[: len(noisy)]})


def test_rows_are_the_shares_of_real_values():
    """Two halves of the image are expected at 40 and 200; real values there are known mixtures."""
    base_model = make_base_model()
    expected = np.full((32, SIDE, SIDE, 3), 40, np.uint8)
    expected[:, :, SIDE // 2 :] = 200
    rng = np.random.default_rng(0)
    frames = np.where(expected == 40, rng.choice([0, 51], expected.shape, p=[0.8, 0.2]),
                      rng.choice([102, 153, 255], expected.shape, p=[0.3, 0.5, 0.2])).astype(np.uint8)  # fmt: skip
    latents = base_model.vae.encode(images_to_tensor(expected))[0].mode() * base_model.scaling_factor
    blind = replace(
        base_model, unet=Blind(latents), scheduler_config={**base_model.scheduler_config, "prediction_type": "sample"}
    )
    table = fit_value_table(blind, frames, latents, torch.zeros(32, 1, 1), timestep=400, seed=0)
    np.testing.assert_allclose(table.sum(axis=1), 1, atol=1e-5)
    # Half of 24,576 values a half and pass: a standard deviation of a share is below .004.
    np.testing.assert_allclose(table[40, [0, 51]], [0.8, 0.2], atol=0.02)
    np.testing.assert_allclose(table[200, [102, 153, 255]], [0.3, 0.5, 0.2], atol=0.02)
    assert np.array_equal(table[0], table[24]), "a value that was never expected is treated as the nearest that was"


@pytest.mark.parametrize("prediction_type", ["sample", "v_prediction", "epsilon"])
def test_clean_latents_of_every_kind_of_prediction(prediction_type):
    from ctlev_core.diffusion.denoising import NoiseSchedule

    base_model = make_base_model()
    schedule = NoiseSchedule({**base_model.scheduler_config, "prediction_type": prediction_type})
    clean, noise = torch.randn(2, 5, 4, 4, 4)
    steps = torch.tensor([0, 100, 500, 800, 950])
    noisy, target = schedule.noised(clean, noise, steps)
    # At step 950 a signal of .03 is divided by: seven digits leave five.
    torch.testing.assert_close(schedule.clean_of(target, noisy, steps), clean, atol=1e-4, rtol=1e-4)


def test_drawn_values_have_the_moments_of_their_row_and_depend_on_their_seed_alone():
    table = np.zeros((256, 256), np.float32)
    table[:, 0] = 1
    table[100] = 0
    table[100, [50, 250]] = 0.75, 0.25
    expected = np.zeros((3, 64, 64, 3))
    expected[:, :, 32:] = 99.6
    drawn = draw_values(expected, table, [(7, 1), (8, 1), (7, 1)])
    assert np.array_equal(drawn[0], drawn[2]) and not np.array_equal(drawn[0], drawn[1])
    assert not drawn[:, :, :32].any() and set(np.unique(drawn[:, :, 32:])) == {50, 250}
    # 12,288 draws of deviation 87: the mean is off by 4 at most in five standard deviations.
    assert abs(drawn[:2, :, 32:].mean() - 100) < 4
    assert np.array_equal(draw_values(expected[1:2], table, [(8, 1)])[0], drawn[1]), "alone or with others"


@pytest.mark.parametrize("palette", ["grey", "red_blue"])
def test_drawn_values_keep_to_the_palette(palette):
    table = np.zeros((256, 256), np.float32)
    table[:, [0, 102]] = 0.85, 0.15  # isolated events anywhere
    base_model = replace(make_base_model(), value_table=table)
    latents = torch.randn((4, base_model.unet.config.in_channels, 4, 4), generator=torch.Generator().manual_seed(0))
    frames = decode_frames(base_model, latents, SamplingOptions(palette=palette, values="drawn"), [1, 2, 3, 4])
    assert set(np.unique(frames)) == {0, 102} and abs((frames[..., 0] > 0).mean() - 0.15) < 0.05
    if palette == "grey":
        assert (frames == frames[..., :1]).all()
    else:
        assert not frames[..., 1].any() and (frames[..., 0] != frames[..., 2]).any()


def test_frames_beyond_what_a_table_takes_are_not_read(monkeypatch):
    frames, conditions = make_data(with_images=False)
    monkeypatch.setattr(value_table, "MAX_PIXELS", 5 * frames[0].size)
    base_model, asked = replace(make_base_model(), controlnet=None), []
    cache = cache_latents(base_model, frames, conditions)
    options = FineTuningOptions(num_validation=0, values_at=0.3)
    monkeypatch.setattr(finetuning, "fit_value_table", lambda model, shown, *_, **__: asked.append(shown))
    finetuning._value_table(base_model, frames, cache, np.arange(len(frames)), options, seed=0)
    assert np.array_equal(asked[0], frames[:5])


def test_a_table_is_made_of_fewer_frames_at_a_time_where_memory_runs_out(monkeypatch):
    frames, conditions = make_data(with_images=False)
    base_model = replace(make_base_model(), controlnet=None)
    batch = cache_latents(base_model, frames, conditions).batch(
        np.arange(len(frames)), torch.Generator().manual_seed(0), 0.0, torch.device("cpu")
    )
    expected, sizes = value_table._expected, []

    def with_room_for_three(*arguments):
        sizes.append(len(arguments[2]))
        if sizes[-1] > 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return expected(*arguments)

    monkeypatch.setattr(value_table, "_expected", with_room_for_three)
    table = fit_value_table(base_model, frames, batch.latents, batch.embeddings, timestep=300, seed=0)
    np.testing.assert_allclose(table.sum(axis=1), 1, atol=1e-5)
    assert max(sizes[-5:]) <= 3


def test_a_checkpoint_carries_its_table(tmp_path):
    frames, conditions = make_data(with_images=False)
    base_model = replace(make_base_model(), controlnet=None)
    options = FineTuningOptions(num_steps=2, batch_size=4, num_validation=0, values_at=0.3)
    history = fine_tune(base_model, frames, conditions, options, tune="unet", seed=0, work=tmp_path / "w")
    assert history.value_table is not None and history.value_table.shape == (256, 256)
    save_base_model(base_model, tmp_path / "checkpoint")
    asked = Conditions(("a photo of a cup",) * 3)
    drawn = SamplingOptions(num_inference_steps=2, values="drawn")
    with pytest.raises(DataError, match="needs a checkpoint that learnt its values"):
        sample(tmp_path, asked, drawn, [1, 2, 3])
    write_value_table(tmp_path / "checkpoint", history.value_table)
    together = sample(tmp_path, asked, drawn, [1, 2, 3])
    assert set(np.unique(together)) <= set(np.unique(frames)), "only values that real frames have"
    assert np.array_equal(sample(tmp_path, asked.take(slice(1, 2)), drawn, [2])[0], together[1])


def sample(folder, conditions, options, seeds):
    return sample_checkpoint(
        folder / "checkpoint", conditions, options, with_controlnet=False, seeds=seeds, work=folder / "work"
    )


def test_damaged_tables_are_refused(tmp_path):
    for wrong in (
        np.ones((256, 256), np.float32),
        np.eye(3, dtype=np.float32),
        np.full((256, 256), np.nan, np.float32),
    ):
        write_value_table(tmp_path, wrong)
        with pytest.raises(DataError, match=r"expected \[256, 256\] float32 probabilities"):
            read_value_table(tmp_path)
    (tmp_path / value_table.TABLE_FOLDER / value_table.TABLE_NAME).write_bytes(b"no array")
    with pytest.raises(DataError, match="cannot be read"):
        read_value_table(tmp_path)


def test_rows_of_different_prompts_are_embedded_in_their_order():
    base_model = make_base_model()
    one, other = encode_prompts(base_model, ["a photo of a cup", "a photo of a ball"])
    assert not torch.equal(one, other)


def test_nearest_values_are_the_nearest_that_were_seen():
    table = np.zeros((256, 256), np.float32)
    table[:, [0, 25, 51, 255]] = 0.25
    expected = np.arange(256.0)[:, None, None, None].repeat(3, axis=3)
    found = draw_values(expected, nearest_values(table), [(row,) for row in range(256)])[:, 0, 0]
    for value, row in zip(range(256), found, strict=True):
        assert (row == min((0, 25, 51, 255), key=lambda level: (abs(level - value), level))).all()
