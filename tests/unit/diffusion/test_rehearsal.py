"""Fine-tuning with pictures beside event images, and with moved frames: repeatable, and refused elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from tiny_base_model import SIDE, make_base_model, make_data

from ctlev_core.diffusion.pretrained.loading import load_base_model
from ctlev_core.diffusion.pretraining import picture_styles, pretraining
from ctlev_core.diffusion.pretraining.picture_scenes import Rehearsal
from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions, draw_chunk, pretrain, split_pictures
from ctlev_core.diffusion.training import finetuning, loop
from ctlev_core.diffusion.training.finetuning import fine_tune, move_frames
from ctlev_core.diffusion.training.options import FineTuningOptions, TrainingOptions
from ctlev_core.pictures.image_moves import Moves
from ctlev_core.pictures.labelled_pictures import PictureOptions
from data_contracts.errors import DataError


@pytest.fixture
def pictures(tmp_path):
    images = np.random.default_rng(0).integers(0, 256, (40, 10, 10), dtype=np.uint8)
    np.savez(tmp_path / "pictures.npz", images=images, labels=np.array(["cup", "ball"] * 20))
    return PictureOptions(root=tmp_path / "pictures.npz")


def tuned(options, work, seed=0):
    frames, conditions = make_data(with_images=False)
    base_model = replace(make_base_model(), controlnet=None)
    fine_tune(base_model, frames, conditions, options, tune="unet", seed=seed, work=work)
    return base_model.unet.state_dict()


def test_rehearsed_training_is_repeatable_and_differs_from_plain(tmp_path, pictures):
    plain = FineTuningOptions(num_steps=3, batch_size=4, num_validation=0, prompt_dropout=0.2)
    rehearsed = plain.model_copy(update={"rehearsal_share": 0.5, "rehearsal": pictures})
    moved = plain.model_copy(update={"moves": Moves(shift=0.2)})
    once, again = (tuned(rehearsed, tmp_path / name) for name in ("a", "b"))
    assert all(torch.equal(once[key], again[key]) for key in once)
    for other in (plain, moved):
        weights = tuned(other, tmp_path / str(other.moves.shift))
        assert any(not torch.equal(once[key], weights[key]) for key in once)


def test_batches_keep_their_size_and_pictures_come_last(tmp_path, pictures, monkeypatch):
    seen = []
    original = finetuning.run_training

    def recording(trainer, denoiser, schedule, fetch, **settings):
        seen.append(fetch(0))
        return original(trainer, denoiser, schedule, fetch, **settings)

    monkeypatch.setattr(finetuning, "run_training", recording)
    options = FineTuningOptions(num_steps=1, batch_size=8, num_validation=0, rehearsal_share=0.25, rehearsal=pictures)
    tuned(options, tmp_path / "w")
    (batch,) = seen
    assert batch.latents.shape[0] == batch.embeddings.shape[0] == 8
    base_model, rng = make_base_model(), np.random.default_rng([0, finetuning.REHEARSAL_STREAM, 0])
    images, _ = Rehearsal(pictures, SIDE).draw(2, rng)
    latents = finetuning.encode_images(base_model, images, torch.Generator())
    torch.testing.assert_close(batch.latents[6:], latents)


def test_captions_name_the_class_of_their_picture(pictures):
    images, captions = Rehearsal(pictures, SIDE).draw(30, np.random.default_rng(3))
    assert images.shape == (30, SIDE, SIDE, 3) and images.dtype == np.uint8
    assert all(("cup" in caption) != ("ball" in caption) for caption in captions)
    assert len({"cup" in caption for caption in captions}) == 2


def test_moves_do_not_depend_on_the_rest_of_the_batch():
    frames, _ = make_data(6, with_images=False)
    options = FineTuningOptions(moves=Moves(shift=0.2, turn_deg=15))
    whole = move_frames(frames, options, 0, 5)
    assert np.array_equal(whole[:3], move_frames(frames[:3], options, 0, 5))
    assert not np.array_equal(whole, move_frames(frames, options, 0, 6))


@pytest.mark.parametrize("asked", [{"moves": Moves(shift=0.1)}, {"values_at": 0.5}])
def test_what_is_for_the_text_route_is_refused_elsewhere(tmp_path, asked):
    frames, conditions = make_data()
    options = FineTuningOptions(num_steps=1, batch_size=2, num_validation=0).model_copy(update=asked)
    with pytest.raises(DataError, match=f"{next(iter(asked))} is for the text route"):
        fine_tune(make_base_model(), frames, conditions, options, tune="both", seed=0, work=tmp_path)


def test_rehearsal_needs_pictures():
    with pytest.raises(ValidationError, match=r"rehearsal_share needs rehearsal\.root"):
        FineTuningOptions(rehearsal_share=0.5)


@pytest.mark.parametrize(("batch_size", "share", "count"), [(4, 0.1, 0), (2, 0.25, 0), (4, 0.9, 4)])
def test_a_share_that_leaves_no_pictures_or_no_frames_is_refused(pictures, batch_size, share, count):
    with pytest.raises(ValidationError, match=f"of batch_size {batch_size} is {count} pictures"):
        FineTuningOptions(rehearsal_share=share, rehearsal=pictures, batch_size=batch_size)


def test_frozen_encoders_compute_in_float32_as_where_their_outputs_are_cached(tmp_path, pictures, monkeypatch):
    seen = []
    encode = finetuning.encode_images

    def watched(*arguments):
        seen.append(torch.is_autocast_enabled("cpu"))
        return encode(*arguments)

    monkeypatch.setattr(finetuning, "encode_images", watched)
    autocast = torch.autocast("cpu", torch.bfloat16)
    monkeypatch.setattr(loop, "autocast", lambda options, device: autocast)  # as on a processor that has bfloat16
    moves = Moves(shift=0.2)
    options = FineTuningOptions(
        num_steps=1, batch_size=4, num_validation=0, moves=moves, rehearsal_share=0.5, rehearsal=pictures
    )
    tuned(options, tmp_path / "w")
    assert seen == [False, False]


TINY = PretrainingOptions(
    training=TrainingOptions(num_steps=2, batch_size=4, warmup_steps=1, log_every=1, validation_every=2, ema_decay=0.5),
    tune="unet", chunk_scenes=8, image_size=16, widths=(32, 32), workers=0,
)  # fmt: skip


def test_a_base_model_of_pictures(tmp_path, pictures, monkeypatch):
    monkeypatch.setattr(pretraining, "FIT_IMAGES", 24)
    options = TINY.model_copy(update={"pictures": pictures})
    one, again = (pretrain(options, tmp_path / name, tmp_path / f"{name}_work") for name in ("a", "b"))
    assert one.loss == again.loss
    base_model = load_base_model(tmp_path / "a", with_controlnet=False)
    assert base_model.image_size == (16, 16)
    for word in ("cup", "ball"):
        assert len(base_model.tokenizer(word).input_ids) == 3, "start, the name as one token, end"


def test_pictures_held_back_are_never_learnt_from(pictures):
    learnt, held_back = split_pictures(40, seed=0)
    assert len(held_back) == 4 and sorted([*learnt, *held_back]) == list(range(40))
    options = TINY.model_copy(update={"pictures": pictures})
    block = draw_chunk(options, 1)
    assert len(block) == 8 and all(isinstance(scene, picture_styles.Scene) for scene in block)
    assert np.array_equal(block[2].image, draw_chunk(options, 1)[2].image)
    assert not np.array_equal(block[2].image, draw_chunk(options, 2)[2].image)


def test_pictures_have_no_condition_images(pictures):
    with pytest.raises(ValidationError, match="pictures of one's own have no condition images; set tune=unet"):
        PretrainingOptions(pictures=pictures)
