"""The pictures behind the bundled prior are a function of their index, and pre-training one of its seed."""

import numpy as np
import pytest
import torch

from ctlev_core.body.motions import HELD_OUT
from ctlev_core.diffusion import pretraining, procedural_images
from ctlev_core.diffusion.options import TrainingOptions
from ctlev_core.diffusion.pretraining import ImageStream, PretrainingOptions, new_prior, pretrain
from ctlev_core.diffusion.prior import encode_prompts, load_prior
from ctlev_core.diffusion.procedural_objects import COLOURS, OBJECTS, draw_object
from data_contracts.errors import TrainingError

TINY = PretrainingOptions(
    training=TrainingOptions(num_steps=4, batch_size=4, warmup_steps=1, log_every=1, validation_every=2, ema_decay=0.5),
    max_seconds=None,
    block_scenes=8,
    image_size=16,
    widths=(32, 32),
    workers=0,
)


@pytest.fixture(autouse=True)
def few_images(monkeypatch):
    """Fit the code and validate on a handful."""
    monkeypatch.setattr(pretraining, "FIT_IMAGES", 24)
    monkeypatch.setattr(pretraining, "VALIDATION_IMAGES", 4)


def same_weights(one, other):
    return all(
        torch.equal(one.unet.state_dict()[key], other.unet.state_dict()[key]) for key in one.unet.state_dict()
    ) and torch.equal(
        one.text_encoder.embeddings.token_embedding.weight, other.text_encoder.embeddings.token_embedding.weight
    )


def test_scenes_do_not_depend_on_order_or_block():
    alone = procedural_images.draw_scene(3, 11, 32)
    inside = procedural_images.draw_block(3, 1, 8, 32)[3]
    np.testing.assert_array_equal(alone.image, inside.image)
    np.testing.assert_array_equal(alone.condition, inside.condition)
    other = procedural_images.draw_scene(4, 11, 32)
    assert not np.array_equal(alone.image, other.image)


def test_mixture_of_people_and_objects():
    scenes = procedural_images.draw_block(0, 0, 60, 32)
    people = [scene for scene in scenes if scene.condition is not None]
    # 60 draws at 0.5: four standard deviations either way.
    assert 15 <= len(people) <= 45
    assert all(scene.condition.any() for scene in people), (
        "a person whose skeleton is out of the picture teaches nothing"
    )


def test_held_out_motions_are_never_drawn(monkeypatch):
    drawn = []
    original = procedural_images.sample_style

    def recording(name, *arguments):
        drawn.append(name)
        return original(name, *arguments)

    monkeypatch.setattr(procedural_images, "sample_style", recording)
    procedural_images.draw_block(1, 0, 150, 16)
    assert len(set(drawn)) > 5
    assert not set(drawn) & set(HELD_OUT)


def test_random_poses_are_rotations():
    pose = np.stack([procedural_images.sample_pose(np.random.default_rng(seed)) for seed in range(20)])
    np.testing.assert_allclose(pose @ np.swapaxes(pose, -1, -2), np.broadcast_to(np.eye(3), pose.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(pose), 1.0, atol=1e-12)


@pytest.mark.parametrize("noun", sorted(OBJECTS))
def test_every_object_is_visible_and_its_parts_fit(noun):
    canvas = np.full((32, 32, 3), 250, np.uint8)
    image = draw_object(noun, "blue", canvas, np.random.default_rng(0))
    changed = (image != canvas).any(axis=2).mean()
    assert 0.01 < changed < 0.95
    assert (canvas == 250).all(), "the background must not be drawn on"
    for part in OBJECTS[noun]:
        assert np.abs(np.array(part.points)).max() <= 1.01


def test_captions_name_what_is_seen_and_the_tokenizer_knows_their_words():
    tokenizer = new_prior(TINY).tokenizer
    rng = np.random.default_rng(0)
    for scene in procedural_images.draw_block(0, 0, 40, 16):
        image, caption = procedural_images.apply_style(scene, rng)
        assert image.dtype == np.uint8 and image.shape == (16, 16, 3)
        if scene.condition is None:
            assert scene.noun in caption
        words = caption.split()
        assert tokenizer.tokenize(caption) == [f"{word}</w>" for word in words]
    for word in (*OBJECTS, *COLOURS, "street", "running", "human", "motorcycle"):
        assert tokenizer.tokenize(word) == [f"{word}</w>"]
    assert tokenizer.eos_token_id == len(tokenizer) - 1, "CLIP finds the end token as the largest id"


def test_batches_put_steered_rows_first_and_follow_the_number_alone():
    prior = new_prior(TINY)
    stream = ImageStream(prior, TINY)
    late = stream.fetch(5)
    batch = ImageStream(prior, TINY).fetch(5)
    assert torch.equal(late.latents, batch.latents) and torch.equal(late.embeddings, batch.embeddings)
    steered = 0 if batch.conditions is None else len(batch.conditions)
    assert steered <= len(batch.latents) == 4
    assert not torch.equal(batch.latents, stream.fetch(6).latents)


@pytest.mark.slow
def test_a_worker_process_draws_the_same_pictures():
    prior = new_prior(TINY)
    stream = ImageStream(prior, TINY.model_copy(update={"workers": 1}))
    try:
        for number in range(6):  # over two blocks
            assert torch.equal(stream.fetch(number).latents, ImageStream(prior, TINY).fetch(number).latents)
    finally:
        stream.close()


def test_pretraining_resumes_and_writes_a_prior(tmp_path):
    history = pretrain(TINY, tmp_path / "whole", tmp_path / "work")
    assert history.step == [1, 2, 3, 4] and history.validation_step == [2, 4]
    whole = load_prior(tmp_path / "whole")
    assert whole.controlnet is not None and whole.image_size == (16, 16)
    # Started again on its own state, a finished run only writes its result again.
    pretrain(TINY, tmp_path / "again", tmp_path / "work")
    assert same_weights(whole, load_prior(tmp_path / "again"))
    with pytest.raises(TrainingError, match="of another run"):
        pretrain(TINY.model_copy(update={"seed": 1}), tmp_path / "other", tmp_path / "work")


def test_the_text_encoder_tells_prompts_apart_and_is_not_trained(tmp_path):
    """A trained one had collapsed: its embeddings differed by 0.01, and no fine-tuning could tell classes apart."""
    before = new_prior(TINY)
    pretrain(TINY, tmp_path / "out", tmp_path / "work")
    for prior in (before, load_prior(tmp_path / "out"), load_prior()):
        prompts = [f"A photo of {name}" for name in ("person", "spot", "street", "leopard")]
        embeddings = encode_prompts(prior, prompts)
        distances = (embeddings[:, None] - embeddings[None]).square().mean(dim=(2, 3)).sqrt()
        assert distances[~torch.eye(len(prompts), dtype=torch.bool)].min() > 0.2
    kept = load_prior(tmp_path / "out").text_encoder.state_dict()
    for name, weight in before.text_encoder.state_dict().items():
        assert torch.equal(kept[name].half(), weight.half()), name


def test_wall_clock_budget_ends_training(tmp_path):
    options = TINY.model_copy(update={"max_seconds": 1e-6})
    history = pretrain(options, tmp_path / "out", tmp_path / "work")
    assert history.step == [1], "one step is made before the clock is looked at"
