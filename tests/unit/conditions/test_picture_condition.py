"""The condition that is a picture: class and seed alone decide which, and what cannot be shown is said."""

import numpy as np
import pytest

from ctlev_core.conditions import picture
from data_contracts.errors import DataError
from data_contracts.labels import Labels

NUM, SIDE = 30, 12


def write_npz(folder, names=("cat", "dog", "owl")):
    """Pictures of which each has a grey level of its own."""
    images = np.repeat(np.arange(NUM, dtype=np.uint8)[:, None], SIDE * SIDE, axis=1).reshape(NUM, SIDE, SIDE)
    path = folder / "pictures.npz"
    np.savez(path, images=images, labels=np.array(names)[np.arange(NUM) % len(names)])
    return path


def labels_of(*names):
    return Labels(names, np.zeros(len(names), np.int64))


def levels(options, names, seeds):
    made = picture.render(labels_of(*names), (64, 48), options, seeds)
    assert made.images is not None and made.images.shape == (len(names), SIDE, SIDE, 3)
    assert made.images.dtype == np.uint8
    return made.images[:, 0, 0, 0].tolist()


def test_class_and_seed_alone_decide_the_picture(tmp_path):
    options = picture.Options(root=write_npz(tmp_path))
    names, seeds = ["cat", "dog", "owl", "cat", "dog", "owl"], [5, 6, 7, 8, 9, 5]
    together = levels(options, names, seeds)
    assert [level % 3 for level in together] == [0, 1, 2, 0, 1, 2]
    assert [levels(options, [name], [seed])[0] for name, seed in zip(names, seeds, strict=True)] == together
    order = [3, 0, 5, 2, 4, 1]
    assert levels(options, [names[i] for i in order], [seeds[i] for i in order]) == [together[i] for i in order]
    assert len(set(levels(options, ["cat"] * 60, range(60)))) == NUM // 3, "every picture of the class gets its turn"


def test_the_prompt_names_the_class(tmp_path):
    made = picture.render(labels_of("cat"), (64, 64), picture.Options(root=write_npz(tmp_path)), [0])
    assert made.prompts == ("A photo of cat",) and made.motions is None


def test_numbered_labels_are_named(tmp_path):
    path = tmp_path / "digits.npz"
    np.savez(path, images=np.zeros((NUM, SIDE, SIDE), np.uint8), labels=np.arange(NUM) % 2)
    options = picture.Options(root=path, class_names=("zero", "one"))
    assert levels(options, ["one"], [0]) == [0]
    with pytest.raises(DataError, match="no picture of class 'one'; there are: 0, 1"):
        levels(picture.Options(root=path), ["one"], [0])


def test_what_cannot_be_shown_is_an_error(tmp_path):
    options = picture.Options(root=write_npz(tmp_path))
    with pytest.raises(DataError, match="no picture of class 'cow'; there are: cat, dog, owl"):
        levels(options, ["cat", "cow"], [0, 1])
    with pytest.raises(DataError, match="no picture of class 'cow'"):
        picture.check_classes({"cat", "cow"}, options)
    picture.check_classes({"cat", "dog"}, options)
    with pytest.raises(DataError, match="1 labels but 2 seeds"):
        levels(options, ["cat"], [0, 1])
    for look in (picture.input_files, lambda options: picture.check_classes(["cat"], options)):
        with pytest.raises(DataError, match="set its option root"):
            look(picture.Options())
    with pytest.raises(DataError, match="no such file or folder"):
        picture.input_files(picture.Options(root=tmp_path / "nowhere"))


def test_the_content_of_the_pictures_is_named(tmp_path):
    path = write_npz(tmp_path)
    assert picture.input_files(picture.Options(root=path)) == [path]


def test_pictures_of_files_are_as_large_as_the_event_image_or_as_asked(tmp_path):
    import cv2

    (tmp_path / "cat").mkdir()
    for number in range(20):
        cv2.imwrite(str(tmp_path / "cat" / f"{number}.png"), np.full((10, 20), 200, np.uint8))
    for options, side in ((picture.Options(root=tmp_path), 64), (picture.Options(root=tmp_path, size=16), 16)):
        made = picture.render(labels_of("cat"), (48, 64), options, [0])
        assert made.images is not None and made.images.shape == (1, side, side, 3) and (made.images == 200).all()
