"""Each option of training does what it says, and a killed run ends as an unkilled one whichever are set."""

import copy
import dataclasses
import logging
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_base_model import make_base_model, make_data, shared_base_model

from ctlev_core.diffusion.denoising import generator_for
from ctlev_core.diffusion.training import acceleration, finetuning, loop, trainer
from ctlev_core.diffusion.training.finetuning import draw_turns, fine_tune, split_rows
from ctlev_core.diffusion.training.float32_attention import use_float32_attention
from ctlev_core.diffusion.training.latent_cache import LatentCache, cache_latents, turn_conditions
from ctlev_core.diffusion.training.muon import MATRIX_RATE, is_matrix
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.generators import controlnet
from ctlev_core.render.normals import turn_normal_map
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError, TrainingError
from data_contracts.labels import Conditions

OPTIONS = FineTuningOptions(num_steps=6, batch_size=4, warmup_steps=2, log_every=2, num_validation=0, ema_decay=0.5)
VALIDATED = OPTIONS.model_copy(update={"num_validation": 4, "validation_every": 1})
FRAMES, CONDITIONS = make_data(40)


def tuned(work, options, tune="unet"):
    base_model = make_base_model()
    return base_model, fine_tune(base_model, FRAMES, CONDITIONS, options, tune=tune, seed=3, work=work)


def weights(base_model):
    return [
        value.clone() for network in (base_model.unet, base_model.controlnet) for value in network.state_dict().values()
    ]


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def on_any_device(monkeypatch):
    """Float16 on a CPU is slow and lacks operations, but what the tests need is there."""
    monkeypatch.setattr(loop, "check_precision", lambda options, device: None)


class Killed(Exception):
    pass


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"lora_rank": 4, "random_init": True}, "random_init forgets it"),
        ({"keep": "best", "num_validation": 1}, "the best weights and early stopping need a validation loss"),
        ({"patience": 2, "num_validation": 0}, "the best weights and early stopping need a validation loss"),
        ({"num_processes": 2}, "gradient_accumulation must be a multiple of the 2 processes"),
        ({"num_processes": 2, "gradient_accumulation": 2, "device": "mps"}, "device must be auto, cuda or cpu"),
        ({"num_processes": 1, "fsdp": True}, "fsdp shares out weights over processes"),
        ({"fsdp": True, "optimizer": "muon"}, "fsdp needs optimizer=adamw, got muon"),
        ({"fsdp": True, "lora_rank": 4}, "set fsdp to false"),
        ({"rot90_probability": 0.5, "moves": {"shift": 0.1}}, "moves is for the text route"),
    ],
)
def test_options_that_contradict_one_another_are_refused_where_a_preset_is_read(asked, message):
    with pytest.raises(ValueError, match=message):
        FineTuningOptions.model_validate(asked)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"moves": {"shift": 0.1}}, "moves is for the text route"),
        ({"values_at": 0.5}, "values_at is for the text route"),
        ({"lora_rank": 4}, "lora_rank needs the package peft"),
    ],
)
def test_what_a_generator_cannot_train_is_refused_before_anything_is_computed(asked, message, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    options = controlnet.Options.model_validate(asked)
    with pytest.raises(DataError, match=message):
        controlnet.check_fit(options, (64, 64), ConditionChoice(name="skeleton"))


KILLED_WITH = {
    "muon": OPTIONS.model_copy(update={"optimizer": "muon"}),
    "best": VALIDATED.model_copy(update={"keep": "best", "patience": 9}),
    "float16": OPTIONS.model_copy(update={"precision": "float16", "gradient_accumulation": 2}),
    "epochs": OPTIONS.model_copy(update={"max_frames": 5}),
    "turned": OPTIONS.model_copy(update={"rot90_probability": 0.5}),
}


@pytest.mark.parametrize("name", KILLED_WITH)
def test_killed_runs_end_in_the_same_weights(tmp_path, monkeypatch, name):
    on_any_device(monkeypatch)
    options = KILLED_WITH[name]
    # Of the scales that a float16 run starts with, one whose first gradients overflow: the state has a history.
    scaler = torch.amp.GradScaler
    monkeypatch.setattr(torch.amp, "GradScaler", lambda device, enabled: scaler(device, 2.0**20, enabled=enabled))
    # The less a network learnt the better: the first weights are the best, and must then come from the saved state.
    losses = finetuning.validation_losses
    monkeypatch.setattr(finetuning, "validation_losses", lambda *given, **named: (-losses(*given, **named)[0], 0.0))
    whole, history = tuned(tmp_path / "whole", options)
    original, updates = trainer.Trainer.update, []

    def update(self, progress):
        if len(updates) == 3:
            raise Killed
        updates.append(self.step)
        return original(self, progress)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(trainer.Trainer, "update", update)
        tuned(tmp_path / "killed", options.model_copy(update={"checkpoint_every_s": 1e-9}))
    state = torch.load(tmp_path / "killed" / "state.pt", weights_only=True)
    resumed, again = tuned(tmp_path / "killed", options)

    assert same(weights(whole), weights(resumed))
    assert repr(vars(history)) == repr(vars(again))  # NaN of a skipped step equals NaN
    assert history.kept_step == (1 if name == "best" else 6)
    assert (state["best"] is not None) == (name == "best")
    if name == "float16":
        assert state["skipped"] > 0 and state["scaler"]["scale"] < 2.0**20


def test_float16_keeps_weights_in_float32_and_steps_over_gradients_that_overflow(tmp_path, monkeypatch):
    on_any_device(monkeypatch)
    scaler, made = torch.amp.GradScaler, []
    monkeypatch.setattr(
        torch.amp,
        "GradScaler",
        lambda device, enabled: made.append(scaler(device, 2.0**20, enabled=enabled)) or made[0],
    )
    options = OPTIONS.model_copy(update={"precision": "float16", "num_steps": 8, "log_every": 8})
    base_model, history = tuned(tmp_path, options)
    assert all(value.dtype == torch.float32 for value in base_model.unet.parameters())
    assert all(bool(torch.isfinite(value).all()) for value in weights(base_model))
    assert 2.0**11 < made[0].get_scale() < 2.0**20
    _, reference = tuned(tmp_path / "plain", options.model_copy(update={"precision": "float32"}))
    # Without the skipped steps the mean is over other batches; half precision itself adds a thousandth.
    assert history.loss[0] == pytest.approx(reference.loss[0], rel=0.3)


def test_float16_is_refused_on_a_cpu(tmp_path):
    with pytest.raises(ValueError, match="float16 needs a CUDA device, got the CPU; use float32 or bfloat16"):
        tuned(tmp_path, OPTIONS.model_copy(update={"precision": "float16"}))


def test_muon_steps_matrices_by_its_own_rate(tmp_path):
    """One step moves a matrix by a nearly orthogonal one: singular values about the documented rate."""
    options = OPTIONS.model_copy(
        update={"optimizer": "muon", "num_steps": 1, "warmup_steps": 0, "weight_decay": 0.0, "ema_decay": 0.0}
    )
    before = make_base_model().unet.mid_block.attentions[0].proj_in.weight.detach().flatten(1)
    base_model, _ = tuned(tmp_path, options)
    after = base_model.unet.mid_block.attentions[0].proj_in.weight.detach().flatten(1)
    assert is_matrix(after) and after.shape[0] == after.shape[1]
    largest = torch.linalg.matrix_norm(after - before, ord=2).item()
    assert 0.6 < largest / (MATRIX_RATE * options.learning_rate) < 1.3  # bfloat16 iterations


def scripted(monkeypatch, losses):
    """Validation losses as given; returns the list that will hold the weights each of them was asked for."""
    seen, remaining = [], list(losses)

    def validation_losses(denoiser, *_, **__):
        seen.append([value.clone() for value in denoiser.unet.state_dict().values()])
        return remaining.pop(0), 9.0

    monkeypatch.setattr(finetuning, "validation_losses", validation_losses)
    return seen


@pytest.mark.parametrize(
    ("losses", "best"),
    [((3.0, 1.0, 2.0, 1.0, 4.0, 5.0), 1), ((math.nan, 2.0, 2.0, math.nan, 3.0, math.inf), 1), ((6, 5, 4, 3, 2, 1), 5)],
)
def test_best_weights_are_those_of_the_lowest_validation_loss(tmp_path, monkeypatch, losses, best):
    seen = scripted(monkeypatch, losses)
    base_model, history = tuned(tmp_path, VALIDATED.model_copy(update={"keep": "best"}))
    assert same(base_model.unet.state_dict().values(), seen[best])
    assert history.kept_step == best + 1
    assert len(seen) == 6


def test_best_weights_need_a_finite_validation_loss(tmp_path, monkeypatch):
    scripted(monkeypatch, [math.nan] * 6)
    with pytest.raises(TrainingError, match=r"no validation loss was finite.*nan"):
        tuned(tmp_path, VALIDATED.model_copy(update={"keep": "best"}))


@pytest.mark.parametrize(("keep", "kept"), [("best", 2), ("last", 4)])
def test_patience_ends_a_run_early(tmp_path, monkeypatch, keep, kept):
    seen = scripted(monkeypatch, (3.0, 1.0, 2.0, 1.0, 0.0))
    options = VALIDATED.model_copy(update={"keep": keep, "patience": 2})
    base_model, history = tuned(tmp_path, options)
    assert history.validation_step == [1, 2, 3, 4]
    assert history.kept_step == kept
    assert same(base_model.unet.state_dict().values(), seen[kept - 1])
    again, _ = tuned(tmp_path, options)  # started again after its end: nothing is trained, nothing validated
    assert len(seen) == 4 and same(weights(base_model), weights(again))


@pytest.mark.parametrize("asked", [{"keep": "best"}, {"patience": 3}])
def test_best_weights_and_patience_need_validation_frames(tmp_path, asked):
    with pytest.raises(ValueError, match="need a validation loss: num_validation of 2 and more, and 20 frames"):
        tuned(tmp_path, OPTIONS.model_copy(update=asked))


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 200), st.integers(0, 30), st.integers(1, 200), st.integers(1, 200), st.integers(0, 99))
def test_fewer_frames_are_among_those_of_more_and_none_is_held_back(count, held_back, few, many, seed):
    few, many = sorted((few, many))
    options = OPTIONS.model_copy(update={"num_validation": held_back})
    validation, everything = split_rows(count, options, seed)
    assert sorted([*validation, *everything]) == list(range(count))
    chosen = [split_rows(count, options.model_copy(update={"max_frames": number}), seed) for number in (few, many)]
    assert all(np.array_equal(rows[0], validation) for rows in chosen)
    (_, fewer), (_, more) = chosen
    assert len(fewer) == min(few, len(everything)) and set(fewer) <= set(more) <= set(everything)


def test_no_more_frames_than_asked_for_are_learnt_from(tmp_path, monkeypatch):
    original, used = LatentCache.batch, set()

    def batch(self, rows, *arguments):
        used.update(rows.tolist())
        return original(self, rows, *arguments)

    monkeypatch.setattr(LatentCache, "batch", batch)
    tuned(tmp_path, OPTIONS.model_copy(update={"max_frames": 3}))
    assert len(used) == 3


def test_names_of_a_class_are_drawn_anew_at_every_step():
    names = ("a photo of a cup", "a photo of a mug", "a photo of a beaker", "a photo of a ball")
    classes = ("cup", "cup", "cup", "ball")
    cache = cache_latents(shared_base_model(), FRAMES[:4], Conditions(names), classes)
    rows = np.tile([0, 3], 600)
    embeddings = cache.batch(rows, generator_for(7), 0.0, torch.device("cpu")).embeddings
    drawn = [int((cache.embeddings - each).abs().sum(dim=(1, 2)).argmin()) for each in embeddings]
    position = {name: row for row, name in enumerate(sorted(names))}
    assert set(drawn[1::2]) == {position["a photo of a ball"]}
    counts = [drawn[0::2].count(position[name]) for name in names[:3]]
    assert sum(counts) == 600
    assert all(142 < count < 258 for count in counts)  # 600 draws at 1/3: five standard deviations either way
    again = cache.batch(rows, generator_for(7), 0.0, torch.device("cpu")).embeddings
    assert torch.equal(embeddings, again)
    own = cache_latents(shared_base_model(), FRAMES[:4], Conditions(names)).batch(
        rows, generator_for(7), 0.0, torch.device("cpu")
    )
    assert torch.equal(own.embeddings[0], cache.embeddings[position[names[0]]].to(own.embeddings))
    assert len({tuple(each.flatten().tolist()) for each in own.embeddings}) == 2


def test_class_names_change_what_is_learnt_and_belong_to_the_run(tmp_path):
    def run(work, class_names):
        base_model = make_base_model()
        fine_tune(
            base_model, FRAMES, CONDITIONS, OPTIONS, tune="unet", seed=3, work=tmp_path / work, class_names=class_names
        )
        return weights(base_model)

    fixed, drawn = run("fixed", None), run("drawn", ["thing"] * 40)
    assert not same(fixed, drawn)
    with pytest.raises(TrainingError, match="of another run"):
        run("fixed", ["thing"] * 40)


def test_turned_frames_are_those_of_turned_pictures():
    base_model = shared_base_model()
    frames, conditions = FRAMES[:5], Conditions(CONDITIONS.prompts[:5], images=FRAMES[5:10])
    rows, turns = np.array([4, 0, 2, 2, 1]), np.array([0, 1, 2, 3, 1])
    cache = cache_latents(base_model, frames, conditions, num_turns=4)
    batch = cache.batch(rows, generator_for(1), 0.0, torch.device("cpu"), turns)
    for position, (row, turn) in enumerate(zip(rows, turns, strict=True)):
        frame = np.rot90(frames[row], turn)[None].copy()
        condition = np.rot90(conditions.images[row], turn)[None].copy()
        alone = cache_latents(base_model, frame, Conditions(conditions.prompts[row : row + 1], images=condition))
        expected = alone.batch(np.array([0]), generator_for(1), 0.0, torch.device("cpu"))
        torch.testing.assert_close(batch.latents[position], expected.latents[0], rtol=1e-5, atol=1e-5)
        assert torch.equal(batch.conditions[position], expected.conditions[0])
        assert torch.equal(batch.embeddings[position], expected.embeddings[0])


def test_the_colours_of_normal_maps_turn_with_the_body():
    images = np.random.default_rng(0).integers(0, 256, (4, 8, 8, 3), np.uint8)
    turns = np.array([1, 0, 3, 2])
    made_by = ConditionChoice(name="normals", options={"convention": "rgb"})
    expected = np.stack([turn_normal_map(image, turn, "rgb") for image, turn in zip(images, turns, strict=True)])
    np.testing.assert_array_equal(turn_conditions(images, turns, made_by), expected)
    pictures = np.stack([np.rot90(image, turn) for image, turn in zip(images, turns, strict=True)])
    for choice in (None, ConditionChoice(name="skeleton")):
        np.testing.assert_array_equal(turn_conditions(images, turns, choice), pictures)
    assert not np.array_equal(expected, pictures)


def test_turns_have_their_share_and_a_stream_of_their_own():
    turns = np.concatenate([draw_turns(16, 0.4, 3, number) for number in range(500)])
    shares = np.bincount(turns, minlength=4) / len(turns)
    # Five standard deviations of 8,000 draws.
    np.testing.assert_allclose(shares, [0.6, 0.4 / 3, 0.4 / 3, 0.4 / 3], atol=5 * (0.24 / 8000) ** 0.5)
    assert np.array_equal(draw_turns(16, 0.4, 3, 7), draw_turns(16, 0.4, 3, 7))
    assert not draw_turns(16, 0.0, 3, 7).any()


def test_only_square_frames_are_turned(tmp_path):
    base_model, wide = make_base_model(), np.zeros((4, 16, 32, 3), np.uint8)
    base_model = dataclasses.replace(base_model, image_size=(32, 16))
    options = OPTIONS.model_copy(update={"rot90_probability": 0.1})
    with pytest.raises(DataError, match=r"square frames, got 32 x 16 px"):
        fine_tune(base_model, wide, Conditions(CONDITIONS.prompts[:4]), options, tune="unet", seed=0, work=tmp_path)


def test_gradient_checkpointing_saves_memory_and_changes_nothing(tmp_path):
    def measured(work, options):
        kept = []
        with torch.autograd.graph.saved_tensors_hooks(
            lambda value: kept.append(value.numel()) or value, lambda value: value
        ):
            base_model, history = tuned(tmp_path / work, options, tune="controlnet")
        return sum(kept), weights(base_model), history, base_model

    options = OPTIONS.model_copy(update={"num_steps": 2})
    plain = measured("plain", options)
    checked = measured("checked", options.model_copy(update={"gradient_checkpointing": True}))
    assert same(plain[1], checked[1]) and plain[2].loss == checked[2].loss
    assert not any(getattr(module, "gradient_checkpointing", False) for module in checked[3].unet.modules())
    # Within a block nothing is kept, and in these networks blocks are most of it.
    assert checked[0] < 0.6 * plain[0]


def test_attention_is_in_float32_on_a_cpu_and_afterwards_as_it_was(tmp_path, monkeypatch):
    attend, seen = torch.nn.functional.scaled_dot_product_attention, set()

    def record(query, *arguments, **settings):
        seen.add(query.dtype)
        return attend(query, *arguments, **settings)

    monkeypatch.setattr(torch.nn.functional, "scaled_dot_product_attention", record)
    base_model, _ = tuned(tmp_path, OPTIONS.model_copy(update={"precision": "bfloat16", "num_steps": 1}), tune="both")
    assert seen == {torch.float32}
    for network in (base_model.unet, base_model.controlnet):
        assert {type(each).__name__ for each in network.attn_processors.values()} == {"AttnProcessor2_0"}
    usual, in_float32 = base_model.unet, copy.deepcopy(base_model.unet)
    use_float32_attention(in_float32)
    noisy, prompts = (2, usual.config.in_channels, 8, 8), (2, 7, usual.config.cross_attention_dim)
    inputs = (torch.randn(noisy), torch.tensor([10, 900]), torch.randn(prompts))
    with torch.no_grad():
        assert torch.equal(usual(*inputs).sample, in_float32(*inputs).sample)
        with torch.autocast("cpu", torch.bfloat16):
            torch.testing.assert_close(usual(*inputs).sample, in_float32(*inputs).sample, rtol=0, atol=0.05)


def test_training_goes_on_without_a_compiler(tmp_path, monkeypatch, caplog):
    def no_compiler(*_, **__):
        raise RuntimeError("no C++ compiler was found")

    plain, _ = tuned(tmp_path / "plain", OPTIONS)
    monkeypatch.setattr(torch, "compile", no_compiler)
    with caplog.at_level(logging.WARNING):
        base_model, _ = tuned(tmp_path / "asked", OPTIONS.model_copy(update={"compile_networks": True}))
    assert "networks run uncompiled: no C++ compiler was found" in caplog.text
    assert same(weights(plain), weights(base_model))


def test_networks_are_compiled_for_the_training_alone(tmp_path, monkeypatch):
    compiled, calls = [], []

    def record(function, **_):
        compiled.append(function)
        return lambda *arguments, **settings: (calls.append(function), function(*arguments, **settings))[1]

    monkeypatch.setattr(acceleration, "compiler_works", lambda device: True)
    monkeypatch.setattr(torch, "compile", record)
    base_model, _ = tuned(tmp_path, OPTIONS.model_copy(update={"compile_networks": True}), tune="both")
    assert len(compiled) == 2 and len(calls) == 2 * OPTIONS.num_steps
    assert base_model.unet._compiled_call_impl is None and base_model.controlnet._compiled_call_impl is None


@pytest.mark.release
def test_compiled_networks_learn_the_same(tmp_path):
    """For real: minutes on a CPU."""
    plain, _ = tuned(tmp_path / "plain", OPTIONS)
    base_model, _ = tuned(tmp_path / "compiled", OPTIONS.model_copy(update={"compile_networks": True}))
    for one, other in zip(weights(plain), weights(base_model), strict=True):
        # Other orders of sums; six steps of 1e-3 and less can turn rounding into a full step where a gradient is 0.
        torch.testing.assert_close(one, other, rtol=0, atol=4e-3)
