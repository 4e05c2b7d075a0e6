"""The PyTorch dataset: the same samples from the store and from an exported folder, whatever reads them."""

from __future__ import annotations

import pickle
import shutil

import cv2
import numpy as np
import pytest
import torch
from generated_frames import REJECTED_ROW, make_generated, make_recorded
from torch.utils.data import ConcatDataset, DataLoader

from ctlev_core.export.event_dataset import EventDataset
from data_contracts.errors import DataError
from tasks.export_images import write_image_folder

ROWS = [row for row in range(7) if row != REJECTED_ROW]


@pytest.fixture
def made(tmp_path):
    return make_generated(tmp_path / "home")


@pytest.fixture(params=["exported", "artefact", "reference"])
def place(request, tmp_path, made):
    """One set of frames, three ways to name it."""
    if request.param == "exported":
        return write_image_folder(made.artefacts, tmp_path / "mine", name="n", notice="")
    return made.synthetic if request.param == "reference" else str(made.synthetic.path)


def test_samples_hold_images_conditions_and_labels(made, place):
    dataset = EventDataset(place)
    assert len(dataset) == 6 and dataset.class_names == ("bow", "jump", "walk") and dataset.joint_set == "dhp19"
    for sample, row in zip(dataset, ROWS, strict=True):
        for name, images in (("image", made.frames), ("condition", made.images)):
            assert sample[name].shape == (3, 14, 20) and sample[name].dtype == torch.float32
            np.testing.assert_array_equal((sample[name] * 255).round().byte().permute(1, 2, 0), images[row])
        assert sample["sample_id"] == f"synthetic/{row:06d}" and sample["seed"] == 100 + row
        assert sample["class_name"] == dataset.class_names[sample["class_index"]] == made.labels.class_names[row]
        assert sample["prompt"] == f"a {sample['class_name']}"
        for name, array in (
            ("joints2d_px", made.labels.joints2d), ("visible", made.labels.visible),
            ("smpl_pose_rad", made.labels.smpl_pose), ("smpl_betas", made.labels.smpl_betas),
            ("smpl_transl_m", made.labels.smpl_transl),
        ):  # fmt: skip
            np.testing.assert_array_equal(sample[name], array[row])
        assert not {"joints3d_mm", "intrinsics_px"} & set(sample)


def test_workers_change_nothing(place):
    """A pickled copy is what a spawned worker gets; spawning one takes seconds of imports."""
    dataset = EventDataset(place)
    alone = list(DataLoader(dataset, batch_size=4))
    copy = pickle.loads(pickle.dumps(dataset))
    workers = list(DataLoader(copy, batch_size=4, num_workers=2, multiprocessing_context="fork"))
    assert [len(batch["seed"]) for batch in alone] == [4, 2]
    for one, other in zip(alone, workers, strict=True):
        assert one.keys() == other.keys()
        for name, value in one.items():
            if isinstance(value, torch.Tensor):
                torch.testing.assert_close(value, other[name], rtol=0, atol=0, equal_nan=True)
            else:
                assert value == other[name]


def test_images_of_the_store_do_not_travel_to_workers(tmp_path):
    sizes = []
    for count in (20, 400):
        dataset = EventDataset(make_generated(tmp_path / "home", count, joints=False).synthetic)
        dataset[0]  # which opens the array
        sizes.append(len(pickle.dumps(dataset)))
    assert (sizes[1] - sizes[0]) / 380 < 14 * 20 * 3 / 2, "less a row than half an image"


def test_real_and_synthetic_frames_go_together(tmp_path, made):
    ref, frames = make_recorded(tmp_path / "home")
    synthetic = EventDataset(made.synthetic, conditions=False)
    real = EventDataset(ref, split="train", class_names=synthetic.class_names)
    assert len(real) == 3 and real[0]["class_index"] == 2 and not {"seed", "prompt", "condition"} & set(real[0])
    assert len(EventDataset(ref)) == 4 and len(EventDataset(ref, split="test")) == 1
    keep = ("image", "joints2d_px", "class_index")
    for dataset in (real, synthetic):
        dataset.transform = lambda sample: {name: sample[name] for name in keep}
    (batch,) = DataLoader(ConcatDataset([real, synthetic]), batch_size=9)
    assert batch["image"].shape == (9, 3, 14, 20)
    np.testing.assert_array_equal((batch["image"][:3] * 255).round().byte().permute(0, 2, 3, 1), frames[:3])


def test_a_transform_sees_the_whole_sample(place):
    def flip(sample):
        sample["joints2d_px"][:, 0] = sample["image"].shape[2] - sample["joints2d_px"][:, 0]
        return sample | {"image": sample["image"].flip(2)}

    plain, flipped = EventDataset(place), EventDataset(place, transform=flip)
    for _ in range(2):  # in-place changes stay with the sample
        joints = torch.stack([plain[2]["joints2d_px"][:, 0], flipped[2]["joints2d_px"][:, 0]]).sum(dim=0)
        torch.testing.assert_close(joints[0], torch.tensor(20.0))


def test_refused_frames_are_there_when_asked_for(made):
    assert [sample["seed"] for sample in EventDataset(made.synthetic, rejected=True)] == list(range(100, 107))


def test_indices(place):
    dataset = EventDataset(place, conditions=False)
    assert dataset[-1]["seed"] == dataset[5]["seed"] and "condition" not in dataset[0]
    for index in (6, -7):
        with pytest.raises(IndexError):
            dataset[index]


def test_what_cannot_be_opened(tmp_path, made):
    home = tmp_path / "home"
    with pytest.raises(DataError, match="got nothing there"):
        EventDataset(tmp_path / "nowhere")
    with pytest.raises(DataError, match="got another folder"):
        EventDataset(home)
    with pytest.raises(DataError, match="holds conditions; expected synthetic or frames"):
        EventDataset(made.conditions)
    with pytest.raises(DataError, match=r"no image is in split 'test'; splits are \{'train': 7\}"):
        EventDataset(made.synthetic, split="test")
    with pytest.raises(DataError, match="class 'bow' is not one of the given class_names"):
        EventDataset(made.synthetic, class_names=["walk", "jump"])
    with pytest.raises(DataError, match="holds no event streams"):
        EventDataset(made.synthetic).read_events(0)
    with pytest.raises(DataError, match="content has changed"):
        EventDataset(made.synthetic.model_copy(update={"digest": "0" * 64}))


def test_conditions_that_are_gone(made):
    shutil.rmtree(made.conditions.path)
    with pytest.raises(DataError, match="its conditions are not in the store; set conditions=False"):
        EventDataset(made.synthetic)
    assert len(EventDataset(made.synthetic, conditions=False)) == 6


def test_damaged_and_missing_images(tmp_path, made):
    folder = write_image_folder(made.artefacts, tmp_path / "mine", name="n", notice="")
    image = folder / "images" / "000" / "synthetic_000004.png"
    image.write_bytes(image.read_bytes()[:30])
    dataset = EventDataset(folder)
    with pytest.raises(DataError, match=r"synthetic_000004\.png: is not an image that can be read"):
        dataset[3]
    image.unlink()
    with pytest.raises(DataError, match=r"synthetic_000004\.png: file is missing"):
        dataset[3]
    cv2.imwrite(str(image), np.zeros((3, 3, 3), np.uint8))
    with pytest.raises(DataError, match=r"synthetic_000004\.png: expected 20 x 14 px, got 3 x 3"):
        dataset[3]
    assert dataset[4]["seed"] == 105
