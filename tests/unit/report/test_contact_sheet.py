"""The contact sheet shows what it says: joints where the labels are, events over conditions."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctlev_core.report.sections import contact_sheet
from data_contracts.labels import Labels


def labels(count, position=(10.5, 20.5), visible=True):
    joints = np.full((count, 13, 2), position, np.float32)
    return Labels(("walk",) * count, np.arange(count), joints, np.full((count, 13), visible), "dhp19")


def test_events_hide_the_condition_and_leave_it_dimmed_elsewhere():
    frame, condition = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), (200, 100, 0), np.uint8)
    frame[1, 2] = 255, 0, 0
    both = contact_sheet.overlay(frame, condition)
    assert both[1, 2].tolist() == [255, 0, 0] and both[0, 0].tolist() == [100, 50, 0]


@pytest.mark.parametrize("side", [32, 64, 100, 256])
def test_a_joint_is_marked_where_it_is(side):
    frames = np.zeros((2, side, side, 3), np.uint8)
    grid = contact_sheet.training_grid(frames, None, labels(2), ["walk", "walk"])
    name, images = grid.rows[-1]
    assert name == "joints" and min(images[0].shape[:2]) >= contact_sheet.SMALLEST_SIDE
    rows, columns = np.nonzero((images[0] == contact_sheet.MARK).all(axis=-1))
    factor = images[0].shape[0] / side
    # The mark is two pixels wide and a pixel off at most.
    assert abs(rows.mean() - 20.5 * factor) <= 1 and abs(columns.mean() - 10.5 * factor) <= 1
    unseen = contact_sheet.training_grid(frames, None, labels(2, visible=False), ["walk", "walk"])
    assert not unseen.rows[-1][1][0].any()


@pytest.mark.parametrize(("per_class", "num_classes", "expected"), [(1, 7, 2), (5, 7, 7), (12, 40, 24)])
def test_every_class_has_its_row_and_single_pictures_share_one(per_class, num_classes, expected):
    classes = [f"motion{i}" for i in range(num_classes) for _ in range(per_class)]
    conditions = np.zeros((len(classes), 16, 16, 3), np.uint8)
    grid = contact_sheet.sampling_grid(conditions, labels(len(classes)), classes)
    assert len(grid.rows) == expected and all(len(images) <= contact_sheet.COLUMNS for _, images in grid.rows)
    assert ("more rows" in grid.caption) == (num_classes > contact_sheet.MAX_ROWS)


def test_no_more_pictures_are_read_than_are_shown():
    class Counted(np.ndarray):
        def __getitem__(self, index):
            read.append(np.arange(len(self))[index].size)
            return np.ndarray.__getitem__(self, index)

    classes, read = [f"motion{number % 200}" for number in range(6000)], []
    names = {"sample_id": list(map(str, range(6000))), "class_name": classes}
    pictures = np.zeros((len(classes), 2, 2, 3), np.uint8).view(Counted)
    stored = SimpleNamespace(
        column=names.__getitem__, has_array=lambda _: True, array=lambda _: pictures, labels=labels(len(classes))
    )
    sections = contact_sheet.contact_sheet_sections(stored, stored, stored)
    assert sum(read) == 2 * contact_sheet.COLUMNS + sum(len(images) for _, images in sections[1].rows)
    assert [len(images) for _, images in sections[1].rows] == [contact_sheet.COLUMNS] * contact_sheet.MAX_ROWS
