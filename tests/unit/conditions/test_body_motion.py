"""Motions as conditions: passed on as they came, shown by the labelled pose, and refused where they do not fit."""

from dataclasses import replace

import numpy as np
import pytest

from ctlev_core.conditions import body_motion, normals
from ctlev_core.labels.body_views import with_joints
from ctlev_core.render import body_normals
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError
from data_contracts.labels import BodyMotions, Labels
from tasks.stage import input_files_of

SIZE = (80, 60)
KEYS = 4


def people(count=5, seed=0):
    random = np.random.default_rng(seed)
    pose = random.normal(0, 0.3, (count, 72)).astype(np.float32)
    pose[:, :3] = [np.pi, 0, 0]
    return Labels(
        ("",) * count,
        1000 * np.arange(count),
        smpl_pose=pose,
        smpl_betas=random.normal(0, 1, (count, 10)).astype(np.float32),
        smpl_transl=random.uniform([-0.2, 0, 3.0], [0.2, 0.3, 4.0], (count, 3)).astype(np.float32),
        intrinsics=np.tile(np.array([80, 80, 40, 30], np.float32), (count, 1)),
    )


def motions_of(labels):
    """Each body walks to the left of its labelled place."""
    walk = np.linspace([0, 0, 0], [-0.3, 0, 0], KEYS).astype(np.float32)
    return BodyMotions(
        labels.t_us[:, None] + 10_000 * np.arange(KEYS),
        labels.t_us,
        np.repeat(labels.smpl_pose[:, None], KEYS, axis=1),
        labels.smpl_transl[:, None] + walk,
        labels.smpl_betas,
        labels.intrinsics,
    )


def render(labels, motions, **options):
    return body_motion.render(labels, SIZE, body_motion.Options(**options), range(len(labels)), motions)


def test_motions_pass_unchanged_and_the_picture_is_the_labelled_pose():
    labels = people(20)
    motions = motions_of(labels)
    conditions = render(labels, motions)
    assert conditions.motions is motions
    assert conditions.prompts == ("A moving human",) * 20
    assert conditions.images.shape == (20, 60, 80, 3) and conditions.images.dtype == np.uint8
    background = conditions.images[0, 0, 0]
    joints = with_joints(labels, SIZE, "smpl")
    hits = []
    for image, points, visible in zip(conditions.images, joints.joints2d, joints.visible, strict=True):
        columns, rows = points[visible].astype(int).T
        hits += (image != background).any(axis=-1)[rows, columns].tolist()
    # Fingers and toes are about as thin as a pixel here.
    assert np.mean(hits) > 0.97


def test_the_picture_is_the_one_of_the_normals_condition():
    labels = people(3)
    expected = normals.render(labels, SIZE, normals.Options(), range(3)).images
    np.testing.assert_array_equal(render(labels, motions_of(labels)).images, expected)


def test_a_row_depends_on_nothing_but_itself(monkeypatch):
    labels = people(7)
    together = render(labels, motions_of(labels)).images
    monkeypatch.setattr(body_normals, "BATCH", 3)
    np.testing.assert_array_equal(render(labels, motions_of(labels), workers=3).images, together)


def test_no_rows_make_no_conditions():
    none = people().take([])
    conditions = render(none, motions_of(none))
    assert len(conditions) == 0 and conditions.images.shape == (0, 60, 80, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"smpl_pose": None, "smpl_betas": None, "smpl_transl": None}, "no SMPL parameters"),
        ({"intrinsics": None}, "no camera intrinsics"),
    ],
)
def test_labels_that_show_no_body_are_refused(change, message):
    labels = people()
    with pytest.raises(DataError, match=message):
        render(replace(labels, **change), motions_of(labels))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: replace(m, intrinsics=-m.intrinsics), "row 0 needs .* positive focal lengths"),
        (lambda m: replace(m, smpl_betas=-m.smpl_betas), "row 0 has smpl_betas .* in the label but"),
        (lambda m: replace(m, t_us=m.t_us[:, ::-1]), "row 0 needs ascending times"),
        (lambda m: replace(m, moment_us=m.moment_us - 1), "row 0 needs ascending times"),
        (lambda m: replace(m, smpl_transl=m.smpl_transl * np.float32(np.nan)), "smpl_transl of row 0 is not finite"),
    ],
)
def test_motions_of_somebody_else_or_of_no_time_are_refused(change, message):
    labels = people()
    with pytest.raises(DataError, match=message):
        render(labels, change(motions_of(labels)))


def test_rows_must_fit():
    labels = people()
    with pytest.raises(DataError, match="5 labels but 3 motions and 5 seeds"):
        render(labels, motions_of(labels.take([0, 1, 2])))
    with pytest.raises(DataError, match="5 labels but 5 motions and 2 seeds"):
        body_motion.render(labels, SIZE, body_motion.Options(), [0, 1], motions_of(labels))


def test_a_body_file_is_part_of_the_key(tmp_path):
    path = tmp_path / "body.npz"
    path.write_bytes(b"")
    choice = ConditionChoice(name="body_motion", options={"body": str(path)})
    assert input_files_of("condition")({"condition": choice}) == [("body.npz", path)]
    missing = ConditionChoice(name="body_motion", options={"body": str(tmp_path / "none.pkl")})
    with pytest.raises(DataError, match=r"none\.pkl: no such file; expected an SMPL body"):
        input_files_of("condition")({"condition": missing})
