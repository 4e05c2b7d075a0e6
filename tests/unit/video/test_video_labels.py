"""Labels of a video on the sensor and between its frames, beside things whose place is known at every time."""

import json
import time
import timeit
from pathlib import Path

import cv2
import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from ctlev_core.video.carried_labels import CarriedLabels, _cut_off, _polygon_area, label_times, write_labels
from ctlev_core.video.coco_masks import read_runs, write_runs
from ctlev_core.video.frames import FrameOptions, open_frames
from ctlev_core.video.label_files import read_video_labels
from ctlev_core.video.label_tables import read_table
from data_contracts.errors import DataError

STORED = (64, 48)
CATEGORIES = [{"id": 1, "name": "person"}, {"id": 4, "name": "ball"}]
STEP_US = 10_000


def folder_of(path, count=9, boxes=None, size=STORED, times=None):
    """Pictures 10 ms apart; a white box on black in each, if boxes are given."""
    path.mkdir(exist_ok=True)
    for number in range(count):
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        if boxes is not None:
            x, y, width, height = boxes[number]
            picture[y : y + height, x : x + width] = 255
        cv2.imwrite(str(path / f"{number}.png"), picture)
    times = np.arange(count) * STEP_US if times is None else times
    (path / "timestamps.txt").write_text("\n".join(str(t * 1e-6) for t in times))
    return path


def annotation(image, box=None, instance: object = 7, category: object = 1, **more):
    one = {"id": image, "image_id": image, "category_id": category, "instance_id": instance} | more
    return one if box is None else one | {"bbox": list(box)}


def coco(path, annotations, images=range(9), changes=None):
    rows = [{"id": k, "frame_id": k, "file_name": "", "width": STORED[0], "height": STORED[1]} for k in images]
    path.write_text(
        json.dumps({"images": rows, "annotations": annotations, "categories": CATEGORIES} | (changes or {}))
    )
    return path


def carried(labels, source, t_us=None, size=None, **options):
    """Annotations by time."""
    frames = open_frames(source, FrameOptions(size=size, **options))
    read = read_video_labels(labels, frames)
    light = [light for _, light in frames]
    times = np.array([one.t_us for one in frames.shown] if t_us is None else t_us, np.int64)
    table = CarriedLabels(read, frames, light[0].shape[::-1]).coco(times, "a.raw")
    assert [image["t_us"] for image in table["images"]] == times.tolist()
    found = {int(t): [] for t in times}
    for one in table["annotations"]:
        assert table["images"][one["image_id"]]["t_us"] == one["t_us"]
        found[one["t_us"]].append(one)
    return found


def box_at(t_us):
    """Of something that moves straight, and grows."""
    return np.array([5 + 2e-4 * t_us, 20 - 1e-4 * t_us, 10 + 5e-5 * t_us, 8.0])


def test_boxes_and_keypoints_go_straight_at_every_time(tmp_path):
    given = [
        annotation(k, box_at(k * STEP_US), keypoints=[*(box_at(k * STEP_US)[:2] + 1), 2, 30, 40, 1, 0, 0, 0])
        for k in range(0, 9, 2)
    ]
    labels = coco(tmp_path / "a.json", given, images=range(0, 9, 2))  # every second frame is labelled
    times = np.arange(0, 80_001, 700)
    for t_us, found in carried(labels, folder_of(tmp_path / "f"), times).items():
        (one,) = found
        np.testing.assert_allclose(one["bbox"], box_at(t_us), atol=1e-3)
        np.testing.assert_allclose(one["keypoints"], [*(box_at(t_us)[:2] + 1), 2, 30, 40, 1, 0, 0, 0], atol=1e-3)
        assert one["instance_id"] == 7 and one["num_keypoints"] == 2 and one["category_id"] == 1


def test_nothing_is_guessed_where_an_instance_is_missing(tmp_path):
    labels = coco(
        tmp_path / "a.json",
        [annotation(k, box_at(0)) for k in (0, 1, 4, 5)] + [annotation(k, box_at(0), 8, 4) for k in range(9)],
    )
    found = carried(labels, folder_of(tmp_path / "f"), np.arange(0, 80_001, 1000))
    known = [t for t, some in found.items() if any(one["instance_id"] == 7 for one in some)]
    assert known == [*range(0, 10_001, 1000), *range(40_000, 50_001, 1000)]
    assert all(any(one["instance_id"] == 8 for one in some) for some in found.values())


def test_nothing_is_guessed_where_frames_without_rows_are_many(tmp_path):
    labels = tmp_path / "a.csv"
    rows = [f"{frame},3,person,{frame},2,10,10" for frame in (0, 1, 2, 6, 7)]
    labels.write_text("frame,instance,category,x,y,width,height\n" + "\n".join(rows))
    found = carried(labels, folder_of(tmp_path / "f"), np.arange(0, 80_001, 5000))
    assert [t for t, some in found.items() if some] == [*range(0, 20_001, 5000), 60_000, 65_000, 70_000]
    assert found[5000][0]["bbox"] == [0.5, 2, 10, 10] and found[5000][0]["instance_id"] == 3


def test_without_ids_annotations_hold_in_their_frame_alone(tmp_path):
    labels = coco(tmp_path / "a.json", [annotation(k, box_at(0), instance=None) for k in range(9)])
    found = carried(labels, folder_of(tmp_path / "f"), np.arange(0, 80_001, 5000))
    assert [t for t, some in found.items() if some] == list(range(0, 80_001, 10_000))
    assert "instance_id" not in found[0][0]


@pytest.mark.parametrize("size", [(32, 24), (128, 96), (24, 24), (40, 12), None])
def test_labels_follow_when_frames_are_scaled_and_cut(tmp_path, size):
    """Where the sensor sees the white box, the label has it."""
    boxes = [(20 + 2 * k, 16, 16, 12) for k in range(9)]
    source = folder_of(tmp_path / "f", boxes=boxes)
    outline = [[x, y, x + w, y, x + w, y + h, x, y + h] for x, y, w, h in boxes]
    masks = [write_runs(light > 0.5) for _, light in open_frames(source, FrameOptions())]
    given = [annotation(k, boxes[k], segmentation=[outline[k]]) for k in range(9)]
    given += [annotation(k, instance="m", segmentation=masks[k]) for k in range(9)]
    found = carried(coco(tmp_path / "a.json", given), source, size=size)
    for t_us, light in open_frames(source, FrameOptions(size=size, gamma=1.0)):
        one, masked = found[t_us]
        seen = np.clip(light, 0, 1)
        left, top, width, height = one["bbox"]
        assert width * height == pytest.approx(seen.sum(), rel=0.04)
        y, x = np.nonzero(seen > 0.5)
        np.testing.assert_allclose([left, top], [x.min(), y.min()], atol=0.51)
        np.testing.assert_allclose([left + width, top + height], [x.max() + 1, y.max() + 1], atol=0.51)
        mask = read_runs(masked["segmentation"], light.shape[::-1])
        assert (mask != (seen > 0.5)).sum() <= 0.12 * mask.sum() and masked["area"] == mask.sum()
        polygon = np.reshape(one["segmentation"][0], (4, 2))
        np.testing.assert_allclose(np.clip(polygon.min(axis=0), 0, None), [left, top], atol=1e-3)


def test_what_leaves_the_sensor_is_cut_or_left_out(tmp_path):
    given = [annotation(k, (60 - 10 * k, 40, 20, 20), keypoints=[70 - 10 * k, 44, 2, 5, 44, 2]) for k in (0, 1)]
    given += [annotation(0, (-30, 0, 20, 20), 9)]
    labels = coco(tmp_path / "a.json", given, images=range(2))
    found = carried(labels, folder_of(tmp_path / "f"))
    (one,) = found[0]
    assert one["bbox"] == [60, 40, 4, 8] and one["keypoints"] == [0, 0, 0, 5, 44, 2] and one["area"] == 32
    assert found[10_000][0]["bbox"] == [50, 40, 14, 8] and found[10_000][0]["num_keypoints"] == 2


def test_a_mask_is_that_of_the_nearer_frame(tmp_path):
    masks = []
    for k in range(2):
        mask = np.zeros(STORED[::-1], bool)
        mask[10 : 20 + k] = True
        masks.append(write_runs(mask))
    labels = coco(tmp_path / "a.json", [annotation(k, segmentation=masks[k]) for k in (0, 1)], images=range(2))
    found = carried(labels, folder_of(tmp_path / "f"), [0, 4000, 5000, 5001, 10_000])
    assert [one["segmentation"] == masks[0] for (one,) in found.values()] == [True, True, True, False, False]
    assert found[5001][0]["segmentation"] == masks[1]


def test_run_lengths_as_a_text_are_those_of_pycocotools():
    mask = np.zeros((24, 32), bool)
    mask[5:15, 8:20] = mask[10:12, 3:30] = mask[0, 0] = True
    text = "01a21UN0000000K8M0000000000000000000005H300000000000000000V1"  # pycocotools 2.0, mask.encode
    np.testing.assert_array_equal(read_runs({"size": [24, 32], "counts": text}, (32, 24)), mask)
    np.testing.assert_array_equal(read_runs(write_runs(mask), (32, 24)), mask)


def test_frames_keep_their_numbers_where_some_are_not_read(tmp_path):
    source = folder_of(tmp_path / "f", times=[0, 10_000, 10_000, *range(30_000, 90_000, 10_000)])
    labels = coco(tmp_path / "a.json", [annotation(k, (2 * k, 3, 10, 10)) for k in range(9)])
    found = carried(labels, source, np.arange(0, 50_001, 5000), start_s=0.0095)
    # Frame 1 is the first; frame 2 has its time and is left out, so 1 and 3 are neighbours.
    assert found[0][0]["bbox"][0] == 2 and found[20_000][0]["bbox"][0] == 6 and found[10_000][0]["bbox"][0] == 4
    assert found[50_000][0]["bbox"][0] == 12


def test_pictures_are_found_by_their_names(tmp_path):
    rows = [{"id": k, "frame_id": k + 1, "file_name": f"imgs/{k}.png"} for k in (2, 1, 0)]
    labels = coco(tmp_path / "a.json", [annotation(k, (2 * k, 3, 10, 10)) for k in range(3)])
    content = json.loads(labels.read_text()) | {"images": rows}
    labels.write_text(json.dumps(content))
    found = carried(labels, folder_of(tmp_path / "f"))
    assert [found[t][0]["bbox"][0] for t in (0, 10_000, 20_000)] == [0, 2, 4]


def test_labels_of_a_still_picture_move_with_it(tmp_path):
    picture = np.zeros((68, 68, 3), np.uint8)
    picture[20:40, 24:44] = 255
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    labels = tmp_path / "a.csv"
    labels.write_text("frame,instance,x,y,width,height,tip_x,tip_y\n0,1,24,20,20,20,24,20\n")
    found = carried(labels, tmp_path / "a.png", size=(34, 34))
    places = set()
    for t_us, light in open_frames(tmp_path / "a.png", FrameOptions(size=(34, 34), gamma=1.0)):
        (one,) = found[t_us]
        centre = [float((light * axis).sum() / light.sum()) + 0.5 for axis in np.mgrid[:34, :34][::-1]]
        np.testing.assert_allclose(np.array(one["bbox"][:2]) + 5, centre, atol=0.05)
        np.testing.assert_allclose(one["keypoints"][:2], one["bbox"][:2], atol=2e-3)
        places.add(tuple(one["bbox"][:2]))
    assert len(places) > 20


POLYGONS = st.lists(st.tuples(st.integers(-40, 90), st.integers(-40, 90)), min_size=3, max_size=3, unique=True)


@hypothesis.given(POLYGONS)
def test_what_is_cut_off_a_polygon_is_what_pixels_lose(corners):
    """A triangle, drawn ten times as large and cut by the picture's edge, has the area of what is left of it."""
    edge, scale = np.array([50.0, 30.0]), 10
    found = _cut_off(np.array(corners, float), edge)
    canvas = np.zeros((30 * scale, 50 * scale), np.uint8)
    cv2.fillPoly(canvas, [scale * np.array(corners, np.int32)], 1)
    around = np.linalg.norm(np.diff(np.array([*corners, corners[0]]), axis=0), axis=1).sum()
    area = _polygon_area(found) if len(found) >= 3 else 0.0
    assert area == pytest.approx(canvas.sum() / scale**2, abs=around / scale + 1)
    assert len(found) == 0 or ((found >= 0).all() and (found <= edge).all())


def test_mot_challenge_counts_frames_from_one_and_has_rows_to_ignore(tmp_path):
    labels = tmp_path / "gt.txt"
    labels.write_text("1,5,4,6,10,12,1,2,0.9\n2,5,6,6,10,12,1,2,0.9\n1,6,1,1,9,9,0,8,1\n")
    found = carried(labels, folder_of(tmp_path / "f"), [0, 5000])
    assert [one["bbox"] for (one,) in found.values()] == [[3, 5, 10, 12], [4, 5, 10, 12]]


def test_keypoints_of_a_table_may_be_missing(tmp_path):
    labels = tmp_path / "a.csv"
    labels.write_text("frame,instance,head_x,head_y,hand_x,hand_y\n0,a,1,2,30,40\n1,a,3,2,,\n")
    frames = open_frames(folder_of(tmp_path / "f"), FrameOptions())
    found = carried(labels, tmp_path / "f", [0, 5000, 10_000])
    assert [one["keypoints"] for (one,) in found.values()] == [
        [1, 2, 2, 30, 40, 2],
        [2, 2, 2, 0, 0, 0],
        [3, 2, 2, 0, 0, 0],
    ]
    (category,) = read_video_labels(labels, frames).categories
    assert category == {"id": 1, "name": "object", "keypoints": ["head", "hand"]}


def test_what_is_written_can_be_read_again(tmp_path):
    source = folder_of(tmp_path / "f")
    frames = open_frames(source, FrameOptions())
    labels = read_video_labels(
        coco(tmp_path / "a.json", [annotation(k, box_at(k * STEP_US)) for k in range(9)]), frames
    )
    list(frames)
    write_labels(tmp_path / "b.json", labels, frames, STORED, "a.raw")
    again = read_video_labels(tmp_path / "b.json", frames)
    (track,) = again.tracks
    assert track.instance == 7 and again.categories == CATEGORIES
    for k, label in track.labels.items():
        assert label.box is not None
        np.testing.assert_allclose(label.box, box_at(k * STEP_US), atol=1e-3)


def test_times_of_labels():
    assert label_times([0, 10_000, 20_000], None).tolist() == [0, 10_000, 20_000]
    assert label_times([0, 10_000, 20_000], 250).tolist() == [0, 4000, 8000, 12_000, 16_000, 20_000]
    for wrong in (0, -1, float("nan"), 2e6):
        with pytest.raises(ValueError, match="label_rate_hz must be above 0"):
            label_times([0], wrong)


BOX = [1, 2, 3, 4]
NAN, INF = float("nan"), float("inf")
HEAD = "frame,instance,x,y,width,height\n"


def given(*annotations):
    return {"annotations": list(annotations)}


def mask(size, counts):
    return given(annotation(0, segmentation={"size": size, "counts": counts}))


WRONG = [
    (
        given(annotation(11, BOX)) | {"images": [{"id": 11, "frame_id": 11}]},
        "labels of frame 11, expected frames 0 to 8",
    ),
    ({"images": [{"id": 0, "width": 63, "height": 48}]}, "image 0 is of 63 x 48 px, expected the frames' 64 x 48"),
    ({"images": [{"id": 0}]}, "image 0 names no frame: expected a frame_id or frame_index from 0 on, or the file name"),
    ({"images": [{"id": k, "frame_id": 1} for k in (0, 1)]}, "image 1: frame 1 or id 1 is that of image 0 too"),
    ({"images": {}}, "expected a list of tables under 'images'"),
    ({"categories": [{"name": "person"}]}, "categories, entry 0: expected an id, got None"),
    (given(annotation(77, BOX)), "annotation 0: image_id 77 is not one of the images"),
    (given(annotation(0, BOX) | {"image_id": []}), "annotation 0: image_id [] is not one"),
    (given(annotation(0, BOX, category=[3])), "annotation 0: category_id [3] is not one of the categories"),
    (given(annotation(0, BOX), annotation(1, [1, NAN, 3, 4])), "annotation 1: bbox must be finite numbers, got nan"),
    (given(annotation(0, keypoints=[-INF, 2, 2])), "annotation 0: keypoints must be finite numbers, got -inf"),
    (given(annotation(0, segmentation=[[1, 2, 3, 4, 5, NAN]])), "annotation 0: segmentation must be finite numbers"),
    (given(annotation(0, [1, 10**400, 3, 4])), "annotation 0: bbox must be numbers of px"),
    (given(annotation(0, [1, "2", 3, 4])), "annotation 0: bbox must be numbers of px, got 2"),
    (given(annotation(0, [1, 2, 3])), "annotation 0: bbox must be 4 numbers"),
    (given(annotation(0, [1, 2, 0, 4])), "a box must have a width and a height above 0, got 0 x 4"),
    (given(annotation(0, keypoints=[1, 2])), "keypoints must be x, y and a flag in turn, got 2 numbers"),
    (given(annotation(0, BOX), annotation(0, BOX)), "annotation 1: instance 7 is in frame 0 twice"),
    (given(annotation(0, BOX), annotation(1, BOX, category=4)), "instance 7 is of category 4, before of 1"),
    (mask([48, 64], [5]), "segmentation: counts must add up to 48 x 64, got 5"),
    (mask([10**9, 10**9], [10**18]), "segmentation: size must be [48, 64]"),
    (mask([48, 64], "\u00ff"), "counts is no text of run lengths"),
    (given(annotation(0, segmentation=[[1, 2, 3, 4]])), "segmentation must be polygons or run lengths"),
    (given(annotation(0)), "annotation 0: expected a bbox, keypoints or a segmentation"),
    (given(), "expected labels, got none"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG)
def test_wrong_coco_is_named_with_its_place(tmp_path, changes, message):
    labels = coco(tmp_path / "labels.json", [annotation(0, BOX)], changes=changes)
    with pytest.raises(DataError) as caught:
        read_video_labels(labels, open_frames(folder_of(tmp_path / "f"), FrameOptions()))
    assert message in str(caught.value) and str(labels) in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,x,y,width,height\n0,1,2,3,4", "no column 'instance'"),
        ("frame,instance,x,y\n0,1,2,3", "a box needs the columns x, y, width, height"),
        ("frame,instance,head_x\n0,1,2", "column 'head_x' is unknown, or its NAME_x or NAME_y is missing"),
        ("frame,instance,mood\n0,1,2", "column 'mood' is unknown"),
        ("frame,frame,instance\n0,1,2", "a column twice"),
        (HEAD + "0,1,2,3,4", "line 2: expected 6 fields, got 5"),
        (HEAD + "0,1,2,3,4,nan", "line 2: box must be finite numbers, got nan"),
        (HEAD + "0,1,2,3,4,wide", "line 2: height must be a number, got 'wide'"),
        (HEAD + "0,,2,3,4,5", "line 2: instance is empty"),
        (HEAD + "0.5,1,2,3,4,5", "line 2: frame must be a whole number"),
        (HEAD + "-1,1,2,3,4,5", "line 2: frame must be a whole number"),
        (HEAD + "9,1,2,3,4,5", "labels of frame 9, expected frames 0 to 8"),
        (HEAD + "2,1,2,3,4,5\n\n1,1,2,3,4,5", "line 4: frames of instance 1 must ascend, got 1"),
        (HEAD + "2,1,2,3,4,5\n2,1,2,3,4,5", "line 3: instance 1 is in frame 2 twice"),
        (HEAD + "2,1,,,,", "line 2: expected a box or a keypoint, got none"),
        ("0,1,2,3,4,5,1", "line 1: frame must be a whole number from the first frame on"),
        ("1,1,2,3", "line 1: expected MOTChallenge's frame, id"),
        ("", "no column 'frame'"),
    ],
)  # fmt: skip
def test_wrong_tables_are_named_with_their_line(tmp_path, text, message):
    labels = tmp_path / "labels.csv"
    labels.write_text(text)
    with pytest.raises(DataError) as caught:
        read_video_labels(labels, open_frames(folder_of(tmp_path / "f"), FrameOptions()))
    assert message in str(caught.value) and str(labels) in str(caught.value) and len(str(caught.value)) < 500


def test_rows_of_a_table_take_time_in_proportion_to_their_number():
    def seconds(count):
        text = HEAD + "\n".join(f"{frame},1,2,3,4,5" for frame in range(count))
        # The best of three, without the collector of garbage: it walks through what all the tests before left.
        return min(timeit.repeat(lambda: read_table(Path("a.csv"), text), timer=time.process_time, number=1, repeat=3))

    assert seconds(16_000) < 24 * seconds(2000)  # the square would be 64


def test_a_moment_looks_at_the_labels_of_its_frame_alone(tmp_path, monkeypatch):
    looked, look = [], CarriedLabels._at
    monkeypatch.setattr(CarriedLabels, "_at", lambda *given: looked.append(given) or look(*given))
    given = [annotation(k, box_at(0), instance=None) for k in range(9) for _ in range(5)]
    found = carried(coco(tmp_path / "a.json", given), folder_of(tmp_path / "f"))
    assert len(looked) == sum(map(len, found.values())) == len(given)


def test_files_that_are_no_labels(tmp_path):
    frames = open_frames(folder_of(tmp_path / "f"), FrameOptions())
    for name, content, message in (
        ("a.json", b"{", "not JSON"),
        ("a.json", b"[" * 100_000, "not JSON"),
        ("a.json", b"[]", "expected COCO's table"),
        ("a.csv", b"\xff\xfe\xfa", "not a file of labels"),
        ("a.xml", b"<a/>", "expected labels as .json"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=message):
            read_video_labels(tmp_path / name, frames)
    with pytest.raises(DataError, match="No such file"):
        read_video_labels(tmp_path / "b.json", frames)


def test_a_video_that_has_fewer_frames_than_it_says(tmp_path):
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, STORED)
    for level in range(6):
        writer.write(np.full((STORED[1], STORED[0], 3), 40 * level, np.uint8))
    writer.release()
    frames = open_frames(path, FrameOptions())
    assert frames.stored_size() == STORED and frames.num_stored == 6
    frames.num_stored = 0  # the container does not say
    labels = read_video_labels(coco(tmp_path / "a.json", [annotation(7, BOX)]), frames)
    list(frames)
    with pytest.raises(DataError, match="labels of frame 7, expected frames 0 to 5"):
        CarriedLabels(labels, frames, STORED)
