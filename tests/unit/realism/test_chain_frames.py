"""What recorded frames become: an exact autoencoder, values, counts, and a denoiser in closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from tiny_base_model import SIDE, make_data, shared_base_model

from ctlev_core.diffusion.denoising import NoiseSchedule
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.realism.chain_frames import Parts, send_through
from data_contracts.labels import Conditions
from data_contracts.realism_chain import Link

SEEDS = [11, 3, 5, 8, 2, 9]
OPTIONS = SamplingOptions(batch_size=4)


def denoised(time_step, evaluations=4):
    return Link(kind="denoised", amount=time_step, max_evaluations=evaluations)


def send(link, frames, conditions, parts=None, seeds=SEEDS, **options):
    parts = parts or Parts(shared_base_model(), OPTIONS.model_copy(update=options))
    return np.concatenate(list(send_through(link, frames, conditions, parts, seeds[: len(frames)])))


def smooth(count=6):
    """Frames the tiny base_model's patch code is nearly exact on, with a faint rest that is dark in event images."""
    frames, conditions = make_data(count)
    return np.maximum(frames, 10), conditions


class OneImage(torch.nn.Module):
    """The exact denoiser of a distribution of one image: it says its latents, whatever it is shown."""

    def __init__(self, unet, latents):
        super().__init__()
        self.config, self.dtype, self.device, self.latents = unet.config, unet.dtype, unet.device, latents

    def forward(self, noisy, timesteps, encoder_hidden_states, **_):
        return type("Output", (), {"sample": self.latents.expand(len(noisy), -1, -1, -1)})


def test_time_step_0_is_the_autoencoder_and_the_treatment_of_values_alone():
    frames, conditions = smooth()
    alone, treated, at_0 = (
        send(link, frames, conditions) for link in (Link(kind="autoencoder"), Link(kind="values"), denoised(0))
    )
    expected = np.where(alone < OPTIONS.black_threshold, 0, alone)
    np.testing.assert_array_equal(treated, expected)
    np.testing.assert_array_equal(at_0, treated)
    assert (alone != treated).any(), "the faint rest is gone"


def test_the_autoencoder_alone_leaves_values_as_they_are():
    """Whatever the options of sampling: decoded here anew, with the autoencoder by itself."""
    frames, conditions = smooth()
    vae = shared_base_model().vae
    with torch.no_grad():
        images = torch.from_numpy(frames.astype(np.float32)).permute(0, 3, 1, 2) / 127.5 - 1
        decoded = vae.decode(vae.encode(images).latent_dist.mean).sample
    expected = ((decoded + 1) * 127.5).clamp(0, 255).round().permute(0, 2, 3, 1).numpy()
    table = np.zeros((256, 256), np.float32)
    table[:, 77] = 1
    parts = Parts(
        dataclasses.replace(shared_base_model(), value_table=table), OPTIONS.model_copy(update={"palette": "grey"})
    )
    found = send(Link(kind="autoencoder"), frames, conditions, parts)
    assert np.abs(found - expected).max() <= 1
    assert (send(Link(kind="values"), frames, conditions, parts) == 77).all(), "drawn from the table of values"


def test_the_exact_denoiser_of_one_image_gives_it_back_from_any_time_step():
    frames, conditions = smooth(1)
    base_model = dataclasses.replace(shared_base_model(), controlnet=None)
    latents = base_model.vae.encode(torch.from_numpy(frames.astype(np.float32)).permute(0, 3, 1, 2) / 127.5 - 1)
    known = dataclasses.replace(
        base_model,
        unet=OneImage(base_model.unet, latents.latent_dist.mean * base_model.scaling_factor),
        scheduler_config={**base_model.scheduler_config, "prediction_type": "sample"},
    )
    prompts = Conditions(conditions.prompts)
    expected = send(Link(kind="values"), frames, prompts, Parts(known, OPTIONS))
    for time_step in (20, 900):
        found = send(denoised(time_step), frames, prompts, Parts(known, OPTIONS))
        assert np.abs(found.astype(int) - expected).max() <= 1
    # A network that errs is told: its frames are others.
    assert np.abs(send(denoised(900), frames, conditions).astype(int) - expected).max() > 20


@pytest.mark.parametrize("kind", ["autoencoder", "values", "denoised"])
def test_rows_do_not_depend_on_the_batch_and_change_with_their_seed(kind):
    frames, conditions = smooth()
    link = denoised(500) if kind == "denoised" else Link(kind=kind)
    together = send(link, frames, conditions)
    rows = [4, 1]
    alone = send(link, frames[rows], conditions.take(rows), seeds=[SEEDS[row] for row in rows], batch_size=1)
    # Convolutions may sum in another order for another batch size: one grey level, or the darkest one.
    assert (np.abs(alone.astype(int) - together[rows]) > 1).mean() < 1e-3
    if kind == "denoised":
        others = send(link, frames, conditions, seeds=[seed + 1 for seed in SEEDS])
        assert (np.abs(others.astype(int) - together).max(axis=(1, 2, 3)) > 1).all()


def test_counts_come_after_values_and_each_row_is_rounded_by_its_own_seed():
    frames, conditions = smooth()
    asked, shown = [], []

    def rounding(made, images, seeds):
        asked.extend(zip(made.copy(), seeds, strict=True))
        shown.extend(images)
        return made // 51 * 51

    parts = Parts(shared_base_model(), OPTIONS, rounding)
    found = send(Link(kind="counts"), frames, conditions, parts)
    treated = send(Link(kind="values"), frames, conditions, parts)
    assert [seed for _, seed in asked] == SEEDS, "not asked for values alone"
    np.testing.assert_array_equal(np.stack(shown), conditions.images)
    np.testing.assert_array_equal(np.stack([made for made, _ in asked]), treated)
    np.testing.assert_array_equal(found, treated // 51 * 51)


def test_what_does_not_go_together_is_refused():
    frames, conditions = smooth()
    num_timesteps = NoiseSchedule(shared_base_model().scheduler_config).num_timesteps
    wrong = {
        f"a time step of 0 to {num_timesteps - 1}, got {num_timesteps}": (denoised(num_timesteps), frames, SEEDS),
        "whole sampling starts from noise": (Link(kind="sampled", amount=3), frames, SEEDS),
        "does not round to whole counts": (Link(kind="counts"), frames, SEEDS),
        "one condition and one seed a frame, got 6 frames, 6 conditions and 5 seeds": (denoised(3), frames, SEEDS[:5]),
        rf"frames must be \[N, {SIDE}, {SIDE}, 3\] uint8": (denoised(3), frames[:, 1:], SEEDS),
    }
    for message, (link, images, seeds) in wrong.items():
        with pytest.raises(ValueError, match=message):
            send_through(link, images, conditions, Parts(shared_base_model(), OPTIONS), seeds)
