"""What a training writes while it runs says what happened, and changes nothing."""

import struct

import cv2
import numpy as np
import pytest
import torch
from tiny_base_model import SIDE, make_base_model, make_data

from ctlev_core.diffusion.training import trainer
from ctlev_core.diffusion.training.finetuning import SHOWN, draw_samples, fine_tune, split_rows
from ctlev_core.diffusion.training.options import FineTuningOptions
from data_contracts.labels import Conditions

OPTIONS = FineTuningOptions(
    num_steps=4, batch_size=4, warmup_steps=2, log_every=2, num_validation=8, validation_every=2, ema_decay=0.5
)
FRAMES, CONDITIONS = make_data(80)


def tuned(work, options, conditions=CONDITIONS, tune="both"):
    base_model = make_base_model()
    return base_model, fine_tune(base_model, FRAMES, conditions, options, tune=tune, seed=3, work=work)


def weights(base_model):
    return [value for network in (base_model.unet, base_model.controlnet) for value in network.state_dict().values()]


def read_events(folder):
    """(step, tag, scalar or None) of every value in the files: length, two checksums and a message per record."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted(folder.glob("events.*")):
        data, start = path.read_bytes(), 0
        while start < len(data):
            (length,) = struct.unpack_from("<Q", data, start)
            event = Event.FromString(data[start + 12 : start + 12 + length])
            start += 16 + length
            for value in event.summary.value:
                found.append((event.step, value.tag, value.simple_value if value.HasField("simple_value") else None))
    return found


def test_curves_and_samples_are_written_and_change_nothing(tmp_path):
    plain, history = tuned(tmp_path / "plain", OPTIONS)
    options = OPTIONS.model_copy(update={"tensorboard": tmp_path / "board", "sample_every": 2})
    stream = torch.get_rng_state()
    logged, again = tuned(tmp_path / "logged", options)
    assert torch.equal(stream, torch.get_rng_state())
    assert all(torch.equal(one, other) for one, other in zip(weights(plain), weights(logged), strict=True))
    assert vars(history) == vars(again)

    (folder,) = (tmp_path / "board").iterdir()
    events = read_events(folder)
    curves = {tag: [value for _, name, value in events if name == tag] for _, tag, _ in events}
    steps = {tag: [step for step, name, _ in events if name == tag] for tag in curves}
    assert steps == {tag: [2, 4] for tag in curves}
    assert curves["loss/training"] == pytest.approx(history.loss)
    assert curves["loss/validation"] == pytest.approx(history.validation_loss)
    assert curves["loss/shuffled"] == pytest.approx(history.shuffled_loss)
    gaps = np.subtract(history.shuffled_loss, history.validation_loss)
    np.testing.assert_allclose(curves["loss/gap"], gaps, atol=1e-6)  # stored as float32
    # Linear decay from 1e-3 to a twentieth of it; the steps logged are the second and the fourth, 0-based 1 and 3.
    assert curves["learning_rate"] == pytest.approx([1e-3 * 2 / 3 * (1 - 0.95 / 4), 1e-3 * (1 - 0.95 * 3 / 4)])
    assert all(value > 0 for value in curves["gradient_norm"] + curves["images_per_second"])
    assert curves["samples"] == [None, None]
    assert sorted(path.name for path in (tmp_path / "logged" / "samples").iterdir()) == [
        "step_000002.png",
        "step_000004.png",
    ]


def test_pictures_show_conditions_real_frames_and_samples(tmp_path):
    tuned(tmp_path, OPTIONS.model_copy(update={"sample_every": 2}))
    pictures = [cv2.imread(str(tmp_path / "samples" / f"step_00000{step}.png"))[..., ::-1] for step in (2, 4)]
    for picture in pictures:
        assert picture.shape == (SHOWN * SIDE, 3 * SIDE, 3)
        condition, real, _ = np.split(picture, 3, axis=1)
        assert np.array_equal(condition, real)  # of these data
        assert all(any(np.array_equal(row, frame) for frame in FRAMES) for row in np.split(real, SHOWN))
    assert np.array_equal(pictures[0][:, : 2 * SIDE], pictures[1][:, : 2 * SIDE]), "the same frames at every step"
    assert not np.array_equal(pictures[0][:, 2 * SIDE :], pictures[1][:, 2 * SIDE :]), "other weights, other samples"


def test_pictures_are_of_the_averaged_weights_and_the_same_noise(tmp_path):
    base_model, _ = tuned(tmp_path, OPTIONS.model_copy(update={"sample_every": 4}))
    picture = cv2.imread(str(tmp_path / "samples" / "step_000004.png"))[..., ::-1]
    held_back = np.sort(split_rows(len(FRAMES), OPTIONS, seed=3)[0])[:SHOWN]
    prompts = tuple(CONDITIONS.prompts[row] for row in held_back)
    # Training ended with the weights of this very step, averaged.
    again = draw_samples(base_model, FRAMES[held_back], Conditions(prompts, CONDITIONS.images[held_back]))
    np.testing.assert_array_equal(picture, again)


def test_text_route_shows_two_columns(tmp_path):
    tuned(tmp_path, OPTIONS.model_copy(update={"sample_every": 4}), Conditions(CONDITIONS.prompts), tune="unet")
    assert cv2.imread(str(tmp_path / "samples" / "step_000004.png")).shape == (SHOWN * SIDE, 2 * SIDE, 3)


def test_a_resumed_run_goes_on_in_the_same_folder(tmp_path, monkeypatch):
    options = OPTIONS.model_copy(update={"tensorboard": tmp_path / "board", "checkpoint_every_s": 1e-9})
    original = trainer.Trainer.update

    def update(self, progress):
        if self.step == 3:
            raise KeyboardInterrupt
        return original(self, progress)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(trainer.Trainer, "update", update)
        tuned(tmp_path / "work", options)
    tuned(tmp_path / "work", options)
    (folder,) = (tmp_path / "board").iterdir()
    assert [step for step, tag, _ in read_events(folder) if tag == "loss/training"] == [2, 4]


def test_nothing_is_written_unless_asked_for(tmp_path):
    tuned(tmp_path, OPTIONS)
    # The latents are of the training itself.
    assert [path.name for path in tmp_path.iterdir() if not path.name.startswith("latents_")] == ["state.pt"]
