"""N-ImageNet: trees in the published layout become chosen recordings with WordNet's names; bad trees are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.datasets import n_imagenet
from ctlev_core.stand_ins.dataset_writers import write_n_imagenet_lists
from data_contracts.config import DatasetChoice, cache_material
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels

TENCH, CRANE_BIRD, CRANE_MACHINE = "n01440764", "n02012849", "n03126707"
NAMES = f"""{TENCH} tench, Tinca tinca
{CRANE_BIRD} crane
{CRANE_MACHINE} Crane
n02113186 Cardigan, Cardigan Welsh corgi
"""
EVENT = np.dtype([("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", np.bool_)])


def write_events(path: Path, rows: list[tuple[int, int, int, int]], compressed: bool = True) -> Path:
    """As the authors' two layouts are read by their code: one structured array, or four plain ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    x, y, t, p = (np.array(column) for column in zip(*rows, strict=True))
    if compressed:
        np.savez_compressed(path, event_data=np.array(rows, EVENT))
    else:
        np.savez(path, x_pos=x.astype(np.int16), y_pos=y.astype(np.int16), timestamp=t, polarity=p.astype(np.bool_))
    return path


ROWS = [(0, 0, 0, 1), (639, 479, 10, 0), (5, 7, 10, 1), (639, 0, 25_000, 0)]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Three classes with six training and three validation files each."""
    root = tmp_path / "N_Imagenet"
    for wordnet_id in (TENCH, CRANE_BIRD, CRANE_MACHINE):
        for number in range(6):
            write_events(root / "extracted_train" / wordnet_id / f"{wordnet_id}_{number}.npz", ROWS)
        for number in range(3):
            path = root / "extracted_val" / wordnet_id / f"ILSVRC2012_val_{wordnet_id[-3:]}{number:05d}.npz"
            write_events(path, ROWS, compressed=False)
    write_n_imagenet_lists(root)
    (root / "LOC_synset_mapping.txt").write_text(NAMES)
    return root


def listed(root: Path, **options) -> list:
    return n_imagenet.list_recordings(n_imagenet.Options(root=root, **options))


def ids(recordings: list, split: str) -> list[str]:
    return [r.recording_id for r in recordings if r.parts == (Part(split),)]


def test_training_files_train_and_validation_files_test(root):
    recordings = listed(root)
    assert len(ids(recordings, "train")) == 18 and len(ids(recordings, "test")) == 9
    first = recordings[0]
    assert first.recording_id == first.subject == f"train/{TENCH}/{TENCH}_0" and first.sensor_size == (640, 480)
    assert first.files == (root / "extracted_train" / TENCH / f"{TENCH}_0.npz", root / "LOC_synset_mapping.txt")
    assert not {r.subject for r in recordings[:18]} & {r.subject for r in recordings[18:]}


def test_classes_that_share_a_name_stay_two(root):
    assert {r.class_name for r in listed(root)} == {"tench", f"crane ({CRANE_BIRD})", f"Crane ({CRANE_MACHINE})"}
    assert n_imagenet.read_synonyms(n_imagenet.Options(root=root)) == {
        "tench": ["tench", "Tinca tinca"],
        f"crane ({CRANE_BIRD})": ["crane"],
        f"Crane ({CRANE_MACHINE})": ["Crane"],
    }


def test_the_choice_follows_the_seed_grows_and_knows_nothing_of_other_classes(root):
    two, four = (listed(root, images_per_class=n, test_images_per_class=1) for n in (2, 4))
    assert len(ids(two, "train")) == 6 and set(ids(two, "train")) < set(ids(four, "train"))
    assert len(ids(two, "test")) == 3 and ids(two, "test") == ids(four, "test")
    choices = {tuple(ids(listed(root, images_per_class=2, seed=seed), "train")) for seed in range(5)}
    assert len(choices) > 1
    only = listed(root, images_per_class=2, test_images_per_class=1, classes=("tench",))
    assert only == [r for r in two if r.class_name == "tench"]
    assert only == listed(root, images_per_class=2, test_images_per_class=1, classes=(TENCH,))


def test_validation_takes_further_training_files(root):
    plain = listed(root, images_per_class=2, test_images_per_class=1)
    recordings = listed(root, images_per_class=2, test_images_per_class=1, validation_images_per_class=2)
    added = [r for r in recordings if r.parts == (Part("validation"),)]
    assert [r for r in recordings if r not in added] == plain and len(added) == 6
    learnt = {r.files[0] for r in plain}
    assert all(r.files[0].parent.parent.name == "extracted_train" and r.files[0] not in learnt for r in added)
    with pytest.raises(ValueError, match="of which images_per_class takes all"):
        n_imagenet.Options(root=root, images_per_class=None, validation_images_per_class=1)


def test_the_paper_s_number_of_images_is_the_default():
    assert n_imagenet.Options(root=Path()).images_per_class == 100
    assert "root" not in cache_material(n_imagenet.Options(root=Path(), names_file=Path("x")))
    with pytest.raises(plugins.PluginError, match="option 'root': field required"):
        plugins.load_options(DatasetChoice(name="n_imagenet"))


def test_lists_decide_and_without_them_the_folders_do(root):
    with_lists = listed(root)
    write_events(root / "extracted_train" / TENCH / "new.npz", ROWS)
    assert listed(root) == with_lists
    (root / "train_list.txt").unlink()
    assert f"train/{TENCH}/new" in ids(listed(root), "train")
    (root / "train_list.txt").write_text(f"C:\\data\\extracted_train\\{TENCH}\\new.npz\n\n")
    assert ids(listed(root, classes=("tench",)), "train") == [f"train/{TENCH}/new"]


@pytest.mark.parametrize("split", ["train", "test"])
def test_events_of_both_layouts(split, root):
    options = n_imagenet.Options(root=root)
    recording = next(r for r in listed(root) if r.parts == (Part(split),))
    events = n_imagenet.read_events(recording, options)
    assert events.sensor_size == (640, 480)
    got = list(zip(events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist(), strict=True))
    assert got == ROWS
    assert check_labels(n_imagenet.read_labels(recording, options), "labels").class_names == (recording.class_name,)


@pytest.mark.parametrize(
    ("rows", "message"), [([(640, 0, 0, 1)], "x must be below 640"), ([(0, 480, 0, 1)], "y must be below 480")]
)
def test_events_outside_the_sensor(rows, message, root):
    file = write_events(root / "extracted_train" / TENCH / f"{TENCH}_0.npz", rows)
    with pytest.raises(DataError, match=message) as error:
        n_imagenet.read_events(listed(root)[0], n_imagenet.Options(root=root))
    assert str(error.value).startswith(str(file))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut"], ids=["empty", "cut"])
def test_files_that_cannot_be_read(content, root):
    (root / "extracted_train" / TENCH / f"{TENCH}_0.npz").write_bytes(content)
    with pytest.raises(DataError, match=f"{TENCH}_0.npz"):
        n_imagenet.read_events(listed(root)[0], n_imagenet.Options(root=root))


def test_names_in_other_files_and_places(root, tmp_path):
    mapping = root / "LOC_synset_mapping.txt"
    names = mapping.rename(tmp_path / "names.txt")
    expected = n_imagenet.read_synonyms(n_imagenet.Options(root=root, names_file=names))
    assert expected["tench"] == ["tench", "Tinca tinca"]
    words = "\ufeffn00001740\tentity\n" + NAMES.replace(" ", "\t", 1) + "\r\n"
    (root / "words.txt").write_text(words, encoding="utf-8")
    assert n_imagenet.read_synonyms(n_imagenet.Options(root=root)) == expected
    (root / "words.txt").unlink()
    with pytest.raises(DataError, match=r"no names of the classes; put LOC_synset_mapping.txt there, .*kaggle\.com"):
        listed(root)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (NAMES.replace(f"{TENCH} tench, Tinca tinca\n", ""), f"no name for class {TENCH} "),
        (NAMES + f"{TENCH} tench again\n", f"line 5: {TENCH} is named twice"),
        (NAMES + "n01440765\n", "line 5: expected `n01440764 tench, Tinca tinca`, got 'n01440765'"),
        ("ImageId,PredictionString\n", "line 1: expected `n01440764 tench"),
    ],
)
def test_names_that_are_wrong(names, message, root):
    (root / "LOC_synset_mapping.txt").write_text(names)
    with pytest.raises(DataError, match=message):
        listed(root)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (f"/x/extracted_train/{TENCH}/a.npz\n/x/extracted_train/{TENCH}/a.npz\n", "line 2: .*a.npz is listed twice"),
        (
            f"/x/extracted_val/{TENCH}/a.npz\n",
            r"line 1: expected a path that ends in extracted_train/nXXXXXXXX/\*\.npz",
        ),
        ("/x/extracted_train/tench/a.npz\n", "got '/x/extracted_train/tench/a.npz'"),
        (f"/x/extracted_train/{TENCH}/../../a.npz\n", "expected a path that ends in"),
        (f"/x/extracted_train/{TENCH}/a.npz 0\n", "expected a path that ends in"),
        ("\n\n", "the list is empty"),
        (f"/x/extracted_train/{TENCH}/gone.npz\n", "not there, though train_list.txt has it"),
        ("/x/extracted_train/n09999999/a.npz\n", "no name for class n09999999"),
    ],
)
def test_lists_that_are_wrong(lines, message, root):
    (root / "train_list.txt").write_text(lines)
    with pytest.raises(DataError, match=message):
        listed(root, classes=(TENCH,))


def test_a_list_that_is_no_text(root):
    (root / "val_list.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match=r"val_list\.txt: cannot be read as text"):
        listed(root)


def assert_refused(root: Path, message: str, shows_tree: bool = True, **options) -> None:
    with pytest.raises(DataError, match=message) as error:
        listed(root, **options)
    assert ("ROOT/\n    train_list.txt" in str(error.value)) == shows_tree


def test_a_root_that_is_missing_or_at_another_level(root, tmp_path):
    assert_refused(tmp_path / "absent", "absent: no such folder")
    assert_refused(tmp_path, "not the dataset itself; the root is .*/N_Imagenet;")
    assert_refused(root / "extracted_train", "extracted_train: lies inside the dataset; the root is .*/N_Imagenet;")
    assert_refused(root / "extracted_train" / TENCH, "lies inside the dataset; the root is .*/N_Imagenet;")


def test_class_folders_that_are_wrong(root):
    for name in ("train_list.txt", "val_list.txt"):
        (root / name).unlink()
    (root / "extracted_train" / "n02113186").mkdir()
    assert_refused(root, r"n02113186: expected \*\.npz files, found none", shows_tree=False)
    write_events(root / "extracted_train" / "n02113186" / "a.npz", ROWS)
    assert_refused(root, "extracted_val: lacks class n02113186", shows_tree=False)
    assert len(listed(root, classes=(TENCH,))) == 9
    (root / "extracted_train" / "tench").mkdir()
    assert_refused(root, "tench: expected folders named by WordNet ids")
    (root / "extracted_train").rename(root / "train")
    assert_refused(root, "extracted_train: no such folder")


def test_an_unknown_class(root):
    assert_refused(root, f"no class 'crane' among 3 such as {TENCH} or tench", shows_tree=False, classes=("crane",))
