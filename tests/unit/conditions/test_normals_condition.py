"""Normal maps as conditions: bodies where their labels are, whoever's body it is, and clear rejections."""

from dataclasses import replace

import numpy as np
import pytest

from ctlev_core.body.layer import BUNDLED_BODY
from ctlev_core.conditions import normals
from ctlev_core.labels.body_views import with_joints
from ctlev_core.render import body_normals
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from tasks.stage import input_files_of

SIZE = (80, 60)


def people(count=5, seed=0):
    random = np.random.default_rng(seed)
    pose = random.normal(0, 0.3, (count, 72)).astype(np.float32)
    pose[:, :3] = [np.pi, 0, 0]
    return Labels(
        ("",) * count,
        np.arange(count),
        smpl_pose=pose,
        smpl_betas=random.normal(0, 1, (count, 10)).astype(np.float32),
        smpl_transl=random.uniform([-0.2, 0, 3.0], [0.2, 0.3, 4.0], (count, 3)).astype(np.float32),
        intrinsics=np.tile(np.array([80, 80, 40, 30], np.float32), (count, 1)),
    )


def render(labels, **options):
    return normals.render(labels, SIZE, normals.Options(**options), range(len(labels)))


def test_every_labelled_joint_lies_in_its_body():
    labels = with_joints(people(20), SIZE, "smpl")
    conditions = render(labels, convention="rgb")
    assert conditions.prompts == ("A moving human",) * 20
    assert conditions.images.shape == (20, 60, 80, 3) and conditions.images.dtype == np.uint8
    hits = []
    for image, joints, visible in zip(conditions.images, labels.joints2d, labels.visible, strict=True):
        columns, rows = joints[visible].astype(int).T
        hits += image.any(axis=-1)[rows, columns].tolist()
    # Fingers and toes are about as thin as a pixel here.
    assert np.mean(hits) > 0.97


def test_a_row_depends_on_nothing_but_itself(monkeypatch):
    labels = people(7)
    together = render(labels).images
    monkeypatch.setattr(body_normals, "BATCH", 3)
    np.testing.assert_array_equal(render(labels, workers=3).images, together)
    np.testing.assert_array_equal(render(labels.take([4]), workers=1).images[0], together[4])


def test_no_rows_make_no_images():
    assert render(people().take([])).images.shape == (0, 60, 80, 3)


def test_a_person_out_of_sight_leaves_the_picture_empty():
    labels = people(2)
    behind = replace(labels, smpl_transl=labels.smpl_transl * np.array([1, 1, -1], np.float32))
    assert not render(behind, convention="rgb").images.any()


def test_another_body_file_is_used_and_its_content_is_part_of_the_key(tmp_path):
    with np.load(BUNDLED_BODY) as arrays:
        taller = dict(arrays)
    taller["v_template"] = taller["v_template"] * np.float32(1.2)
    path = tmp_path / "tall.npz"
    np.savez(path, **taller)
    labels = people(3)
    heights = [
        np.ptp(np.nonzero(images.any(axis=(0, 2, 3)))[0])
        for images in (render(labels, convention="rgb").images, render(labels, convention="rgb", body=path).images)
    ]
    assert heights[1] > 1.1 * heights[0]
    choice = ConditionChoice(name="normals", options={"body": str(path)})
    assert input_files_of("condition")({"condition": choice}) == [("tall.npz", path)]
    missing = ConditionChoice(name="normals", options={"body": str(tmp_path / "none.pkl")})
    with pytest.raises(DataError, match=r"none\.pkl: no such file; expected an SMPL body"):
        input_files_of("condition")({"condition": missing})
    assert input_files_of("condition")({"condition": ConditionChoice(name="skeleton")}) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"smpl_pose": None, "smpl_betas": None, "smpl_transl": None}, "use condition 'skeleton' for joints"),
        ({"intrinsics": None}, "no camera intrinsics"),
    ],
)
def test_labels_that_show_no_body_are_refused(change, message):
    with pytest.raises(DataError, match=message):
        render(replace(people(), **change))


def test_a_pose_that_is_not_finite_is_refused_by_row():
    labels = people()
    labels.smpl_pose[3, 7] = np.nan
    with pytest.raises(DataError, match=r"3.*(nan|not finite)|(nan|not finite).*3"):
        render(labels)


def test_seeds_must_fit():
    with pytest.raises(DataError, match="5 labels but 2 seeds"):
        normals.render(people(), SIZE, normals.Options(), [0, 1])
