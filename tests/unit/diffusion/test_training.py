"""The loop is a function of its seed: killed and resumed it ends in the same weights."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_base_model import make_base_model, make_data, shared_base_model

from ctlev_core.diffusion.denoising import Batch, Denoiser, Emphasis, NoiseSchedule, generator_for
from ctlev_core.diffusion.training import loop
from ctlev_core.diffusion.training.finetuning import fine_tune, forget_weights
from ctlev_core.diffusion.training.loop import sample_rows
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.supervised import batches
from data_contracts.errors import TrainingError
from data_contracts.labels import Conditions

OPTIONS = FineTuningOptions(num_steps=6, batch_size=4, warmup_steps=2, log_every=2, num_validation=0, ema_decay=0.5)


def weights(base_model):
    return {
        f"{name}.{key}": value.clone()
        for name in ("unet", "controlnet", "text_encoder")
        for key, value in getattr(base_model, name).state_dict().items()
    }


def changed_networks(before, after):
    return {key.split(".")[0] for key in before if not torch.equal(before[key], after[key])}


class Killed(Exception):
    pass


def kill_after(monkeypatch, updates):
    """Let the process die inside the given update, after the state of the previous step was saved."""
    original, count = loop.Trainer.update, [0]

    def update(self, progress):
        if count[0] == updates:
            raise Killed
        count[0] += 1
        return original(self, progress)

    monkeypatch.setattr(loop.Trainer, "update", update)


@pytest.mark.parametrize("accumulation", [1, 2])
def test_resumed_run_ends_in_the_same_weights(tmp_path, monkeypatch, accumulation):
    options = OPTIONS.model_copy(update={"gradient_accumulation": accumulation})
    frames, conditions = make_data()
    whole = make_base_model()
    history = fine_tune(whole, frames, conditions, options, tune="both", seed=3, work=tmp_path / "whole")

    with monkeypatch.context() as patch, pytest.raises(Killed):
        kill_after(patch, 3)
        often = options.model_copy(update={"checkpoint_every_s": 1e-9})
        fine_tune(make_base_model(), frames, conditions, often, tune="both", seed=3, work=tmp_path / "killed")
    resumed = make_base_model()
    again = fine_tune(resumed, frames, conditions, options, tune="both", seed=3, work=tmp_path / "killed")

    assert changed_networks(weights(whole), weights(resumed)) == set()
    assert history.step == again.step == [2, 4, 6]
    assert history.loss == again.loss


def test_weights_that_are_not_averaged_are_kept_once(tmp_path):
    """The same weights as of an average that forgets at once, a saved state without them, and resumed alike."""
    frames, conditions = make_data(40)
    found, sizes = [], []
    for ema_decay in (0.0, 1e-12):
        options = OPTIONS.model_copy(update={"ema_decay": ema_decay, "num_validation": 4, "keep": "best"})
        base_model = make_base_model()
        fine_tune(base_model, frames, conditions, options, tune="unet", seed=3, work=tmp_path / str(ema_decay))
        found.append(weights(base_model))
        sizes.append((tmp_path / str(ema_decay) / "state.pt").stat().st_size)
    for name, value in found[0].items():
        torch.testing.assert_close(value, found[1][name], rtol=1e-5, atol=1e-7)
    stored = sum(4 * value.numel() for value in make_base_model().unet.parameters())
    assert sizes[1] - sizes[0] == pytest.approx(stored, rel=0.05)
    options = OPTIONS.model_copy(update={"ema_decay": 0.0, "num_validation": 4, "keep": "best"})
    again = make_base_model()
    fine_tune(again, frames, conditions, options, tune="unet", seed=3, work=tmp_path / "0.0")
    assert changed_networks(found[0], weights(again)) == set()


def test_other_seed_gives_other_weights(tmp_path):
    frames, conditions = make_data()
    one, other = make_base_model(), make_base_model()
    fine_tune(one, frames, conditions, OPTIONS, tune="both", seed=1, work=tmp_path / "one")
    fine_tune(other, frames, conditions, OPTIONS, tune="both", seed=2, work=tmp_path / "other")
    assert changed_networks(weights(one), weights(other)) == {"unet", "controlnet"}


@pytest.mark.parametrize(("tune", "learns"), [("unet", {"unet"}), ("controlnet", {"controlnet"})])
def test_only_the_named_network_learns(tmp_path, tune, learns):
    base_model = make_base_model()
    before = weights(base_model)
    frames, conditions = make_data()
    fine_tune(base_model, frames, conditions, OPTIONS, tune=tune, seed=0, work=tmp_path)
    assert changed_networks(before, weights(base_model)) == learns


def test_learns_and_uses_its_condition(tmp_path):
    """On bars that stand where the condition says, loss falls and another bar's condition becomes worse."""
    frames, conditions = make_data(200)
    options = OPTIONS.model_copy(
        update={"num_steps": 60, "batch_size": 16, "learning_rate": 3e-3, "ema_decay": 0.9, "num_validation": 20}
    )
    history = fine_tune(make_base_model(), frames, conditions, options, tune="both", seed=0, work=tmp_path)
    assert np.mean(history.loss[-5:]) < 0.7 * history.loss[0]
    assert history.shuffled_loss[-1] > 1.05 * history.validation_loss[-1]
    assert history.validation_step == [60]


def test_text_route_needs_no_condition_images(tmp_path):
    frames, conditions = make_data(40, with_images=False)
    options = OPTIONS.model_copy(update={"num_validation": 4, "prompt_dropout": 0.5})
    base_model = make_base_model()
    history = fine_tune(base_model, frames, conditions, options, tune="unet", seed=0, work=tmp_path)
    assert len(history.validation_loss) == 1 and math.isfinite(history.shuffled_loss[0])


def test_state_of_another_run_is_refused(tmp_path):
    frames, conditions = make_data()
    fine_tune(make_base_model(), frames, conditions, OPTIONS, tune="unet", seed=0, work=tmp_path)
    with pytest.raises(TrainingError, match="of another run, delete it"):
        fine_tune(make_base_model(), frames[::-1], conditions, OPTIONS, tune="unet", seed=0, work=tmp_path)
    other = make_base_model()
    with torch.no_grad():  # frozen here, and yet what the saved ControlNet belongs to
        next(other.unet.parameters()).add_(0.1)
    fine_tune(make_base_model(), frames, conditions, OPTIONS, tune="controlnet", seed=0, work=tmp_path / "frozen")
    with pytest.raises(TrainingError, match="of another run, delete it"):
        fine_tune(other, frames, conditions, OPTIONS, tune="controlnet", seed=0, work=tmp_path / "frozen")
    (tmp_path / "state.pt").write_bytes(b"half a file")
    with pytest.raises(TrainingError, match="cannot be read, delete it"):
        fine_tune(make_base_model(), frames, conditions, OPTIONS, tune="unet", seed=0, work=tmp_path)


def test_non_finite_losses_are_skipped_then_raised(tmp_path, monkeypatch):
    frames, conditions = make_data()
    original = loop.denoising_loss
    calls = []

    def sometimes_nan(*arguments):
        calls.append(len(calls))
        return original(*arguments) * (math.nan if calls[-1] in (1, 2) else 1.0)

    monkeypatch.setattr(loop, "denoising_loss", sometimes_nan)
    base_model = make_base_model()
    history = fine_tune(base_model, frames, conditions, OPTIONS, tune="unet", seed=0, work=tmp_path / "some")
    assert all(math.isfinite(loss) for loss in history.loss)
    assert all(bool(torch.isfinite(value).all()) for value in weights(base_model).values())

    monkeypatch.setattr(loop, "denoising_loss", lambda *arguments: original(*arguments) * math.nan)
    options = OPTIONS.model_copy(update={"num_steps": 30})
    with pytest.raises(TrainingError, match="not finite 10 times in a row, the last at step 9"):
        fine_tune(make_base_model(), frames, conditions, options, tune="unet", seed=0, work=tmp_path / "all")


@pytest.mark.parametrize(
    ("frames", "conditions", "message"),
    [
        (np.zeros((2, 8, 8, 3), np.uint8), Conditions(("a", "b")), r"frames must be \[N, 16, 16, 3\] uint8"),
        (np.zeros((2, 16, 16, 3), np.float32), Conditions(("a", "b")), "uint8.*got .* float32"),
        (np.zeros((2, 16, 16, 3), np.uint8), Conditions(("a",)), "2 frames do not match 1 prompts"),
        (np.zeros((0, 16, 16, 3), np.uint8), Conditions(()), "at least one frame"),
        (
            np.zeros((1, 16, 16, 3), np.uint8),
            Conditions(("a",), np.zeros((1, 32, 32, 3), np.uint8)),
            r"conditions must be \[N, 16, 16, 3\]",
        ),
    ],
)
def test_wrong_data_is_named(tmp_path, frames, conditions, message):
    with pytest.raises(ValueError, match=message):
        fine_tune(shared_base_model(), frames, conditions, OPTIONS, tune="unet", seed=0, work=tmp_path)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 40), st.integers(1, 50), st.integers(0, 1000))
def test_every_epoch_visits_every_row_once(count, batch_size, seed):
    steps = math.ceil(3 * count / batch_size)
    rows = np.concatenate([sample_rows(seed, step, batch_size, count) for step in range(steps)])
    for epoch in range(3):
        assert sorted(rows[epoch * count : (epoch + 1) * count]) == list(range(count))


def test_an_epoch_is_shuffled_once_and_not_at_every_step():
    """Of a million frames that takes longer than a small network's step."""
    batches._permutation.cache_clear()
    expected = np.random.default_rng([3, 1]).permutation(100)
    rows = np.concatenate([sample_rows(3, step, 10, 100) for step in range(10, 20)])
    assert np.array_equal(rows, expected) and batches._permutation.cache_info().misses == 1


def test_min_snr_weights_follow_the_definition():
    config = dict(shared_base_model().scheduler_config)
    timesteps = torch.tensor([0, 100, 500, 900, 999])
    for prediction, denominator in (("v_prediction", 1.0), ("epsilon", 0.0)):
        schedule = NoiseSchedule({**config, "prediction_type": prediction})
        alpha_bar = schedule.alphas_cumprod[timesteps].double()
        snr = alpha_bar / (1 - alpha_bar)
        expected = torch.clamp(snr, max=5.0) / (snr + denominator)
        got = schedule.loss_weights(timesteps, Emphasis(5.0)).double()
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=0)
    assert torch.equal(schedule.loss_weights(timesteps), torch.ones(5))


def test_a_network_that_predicts_the_latents_is_weighted_like_one_that_predicts_v():
    """|v - v'|^2 = (snr + 1) |x - x'|^2 at the same noisy latents: equal networks have equal losses up to the cap."""
    schedule = NoiseSchedule({**shared_base_model().scheduler_config, "prediction_type": "sample"})
    latents, noise = torch.randn(2, 3, 4, 4), torch.randn(2, 3, 4, 4)
    assert torch.equal(schedule.noised(latents, noise, torch.tensor([10, 800]))[1], latents)
    weights = schedule.loss_weights(torch.arange(1000))
    assert weights.mean().item() == pytest.approx(1.0)
    expected = torch.clamp(1 / (1 - schedule.alphas_cumprod), max=5.0)
    torch.testing.assert_close(weights / weights[-1], expected / expected[-1])
    snr = schedule.alphas_cumprod / (1 - schedule.alphas_cumprod)
    torch.testing.assert_close(schedule.loss_weights(torch.arange(1000), Emphasis(5.0)), snr.clamp(max=5.0))


@given(st.floats(0.3, 4.0), st.integers(0, 2**31))
def test_time_steps_have_the_density_that_is_asked_for(power, seed):
    drawn = Emphasis(timestep_power=power).draw(4000, 1000, generator_for(seed))
    assert int(drawn.min()) >= 0 and int(drawn.max()) <= 999
    # Kolmogorov and Smirnov's distance to t ** power: above 0.04 once in 180,000 times, at 4,000 draws; bins of .001.
    sorted_shares = (drawn.double().sort().values + 1) / 1000
    assert (sorted_shares**power - torch.arange(1, 4001) / 4000).abs().max() < 0.04 + 0.001 ** min(power, 1.0)


def test_evenly_drawn_time_steps_are_those_of_torch():
    drawn = Emphasis().draw(9, 1000, generator_for(3))
    assert torch.equal(drawn, torch.randint(0, 1000, (9,), generator=generator_for(3)))


def test_min_snr_weights_are_finite_at_zero_terminal_snr():
    config = {**shared_base_model().scheduler_config, "rescale_betas_zero_snr": True}
    for prediction in ("v_prediction", "epsilon", "sample"):
        schedule = NoiseSchedule({**config, "prediction_type": prediction})
        assert bool(torch.isfinite(schedule.loss_weights(torch.arange(1000), Emphasis(5.0))).all())


def test_velocity_target_follows_the_definition():
    schedule = NoiseSchedule(shared_base_model().scheduler_config)
    generator = torch.Generator().manual_seed(0)
    latents, noise = torch.randn((2, 3, 4, 4), generator=generator), torch.randn((2, 3, 4, 4), generator=generator)
    timesteps = torch.tensor([10, 800])
    noisy, target = schedule.noised(latents, noise, timesteps)
    alpha = schedule.alphas_cumprod[timesteps].sqrt()[:, None, None, None]
    sigma = (1 - alpha**2).sqrt()
    torch.testing.assert_close(noisy, alpha * latents + sigma * noise)
    torch.testing.assert_close(target, alpha * noise - sigma * latents)


def test_unsteered_rows_equal_the_u_net_alone():
    base_model = shared_base_model()
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    generator = generator_for(0, 1)
    batch = Batch(
        torch.randn((3, 48, 4, 4), generator=generator),
        torch.randn((3, 24, 64), generator=generator),
        torch.rand((1, 3, 16, 16), generator=generator),
    )
    timesteps = torch.tensor([5, 300, 900])
    with torch.no_grad():
        mixed = denoiser.predict(batch.latents, timesteps, batch.embeddings, batch.conditions)
        alone = Denoiser(base_model.unet).predict(batch.latents, timesteps, batch.embeddings, None)
    # Other sums, same mathematics: float32 rounding.
    torch.testing.assert_close(mixed[1:], alone[1:], rtol=1e-4, atol=1e-5)
    assert (mixed[0] - alone[0]).abs().max() > 1e-3


def test_forgotten_weights_are_random_and_repeatable():
    base_model = shared_base_model()
    one, two, other = forget_weights(base_model, 0), forget_weights(base_model, 0), forget_weights(base_model, 1)
    assert changed_networks(weights(one), weights(two)) == set()
    assert changed_networks(weights(one), weights(other)) == {"unet", "controlnet"}
    assert changed_networks(weights(base_model), weights(one)) == {"unet", "controlnet"}
