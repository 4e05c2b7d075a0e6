"""Pictures of a user's own: three layouts, the same pictures; what cannot be read is said before training starts."""

import gzip
import io
import os
import struct
import zipfile

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from pydantic import ValidationError

from ctlev_core.dataset_files.event_hpe_files import read_event_images
from ctlev_core.dataset_files.picture_files import read_grey_pictures
from ctlev_core.pictures import labelled_pictures
from ctlev_core.pictures.image_moves import Moves, move_image
from ctlev_core.pictures.labelled_pictures import PictureOptions, _open, move, open_pictures, read_picture
from data_contracts.errors import DataError


def pictures(count=24, side=12):
    return np.random.default_rng(0).integers(0, 256, (count, side, side), dtype=np.uint8)


def write_idx(folder, images, labels, *, packed=False):
    folder.mkdir(exist_ok=True)
    for name, array in (("train-images-idx3-ubyte", images), ("train-labels-idx1-ubyte", labels)):
        data = struct.pack(f">{1 + array.ndim}I", 0x800 | array.ndim, *array.shape) + array.tobytes()
        if packed:
            (folder / f"{name}.gz").write_bytes(gzip.compress(data))
        else:
            (folder / name).write_bytes(data)
    return folder


def write_folders(root, images, names):
    for number, (image, name) in enumerate(zip(images, names, strict=True)):
        (root / name).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / name / f"{number:03d}.png"), image)
    return root


def test_all_layouts_give_the_same_pictures(tmp_path):
    images, labels = pictures(), np.arange(24, dtype=np.uint8) % 2
    names = ["cat" if label == 0 else "dog" for label in labels]
    np.savez(tmp_path / "numbers.npz", images=images, labels=labels)
    np.savez(tmp_path / "names.npz", images=images, labels=np.array(names))
    places = [
        tmp_path / "numbers.npz",
        tmp_path / "names.npz",
        write_idx(tmp_path / "idx", images, labels),
        write_idx(tmp_path / "gz", images, labels, packed=True),
        write_folders(tmp_path / "folders", images, names),
    ]
    for place in places:
        found = open_pictures(PictureOptions(root=place, class_names=["cat", "dog"]))
        assert found.classes == ("cat", "dog") and len(found) == 24
        shown = {(name, found.read(row, 12).tobytes()) for row, name in enumerate(found.names)}
        expected = {(n, np.repeat(i[..., None], 3, axis=2).tobytes()) for n, i in zip(names, images, strict=True)}
        assert shown == expected, place


def test_numbers_without_names_are_called_by_their_number(tmp_path):
    np.savez(tmp_path / "n.npz", images=pictures(), labels=np.arange(24) % 3)
    assert open_pictures(PictureOptions(root=tmp_path / "n.npz")).classes == ("0", "1", "2")


def test_other_sizes_and_colour_modes(tmp_path):
    rng = np.random.default_rng(1)
    wide = rng.integers(0, 256, (10, 40, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "wide.png"), wide)
    assert np.array_equal(read_picture(tmp_path / "wide.png"), wide[..., ::-1]), "red first"
    deep = np.full((6, 6), 0x80FF, np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    assert (read_picture(tmp_path / "deep.png") == 0x80).all()
    clear = np.full((6, 6, 4), 200, np.uint8)
    clear[..., 3] = np.arange(6, dtype=np.uint8) * 51
    cv2.imwrite(str(tmp_path / "clear.png"), clear)
    assert read_picture(tmp_path / "clear.png")[0, :, 0].tolist() == [0, 40, 80, 120, 160, 200]
    np.savez(tmp_path / "w.npz", images=np.repeat(wide[None], 20, axis=0), labels=np.zeros(20, int))
    fitted = open_pictures(PictureOptions(root=tmp_path / "w.npz")).read(0, 16)
    assert fitted.shape == (16, 16, 3)
    assert (fitted[:6] == fitted[0, 0]).all() and (fitted[10:] == fitted[0, 0]).all(), "whole, with its border's colour"


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["photo.jpg", "really_a_jpeg.png"])
def test_photos_are_turned_upright(tmp_path, orientation, name):
    corner = np.zeros((32, 48, 3), np.uint8)
    corner[:16, :24] = 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    photo = Image.fromarray(corner)
    photo.save(tmp_path / name, "JPEG", exif=exif, quality=95)
    with Image.open(tmp_path / name) as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored))
    found = read_picture(tmp_path / name)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, atol=3)


def test_moves_are_a_function_of_the_stream():
    image = np.random.default_rng(2).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    options = PictureOptions()
    one, again, other = (move(image, options, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(one, again) and not np.array_equal(one, other)
    assert move_image(image, Moves(), np.random.default_rng(0), interpolation="nearest") is image


def test_nearest_moves_keep_the_values_of_event_images():
    image = np.zeros((16, 16, 3), np.uint8)
    image[5:11, 5:11, 0] = np.random.default_rng(0).choice([51, 102, 153], (6, 6))
    moves = Moves(shift=0.2, turn_deg=20, scale=0.2)
    for seed in range(20):
        moved = move_image(image, moves, np.random.default_rng(seed), interpolation="nearest")
        assert set(np.unique(moved)) <= {0, 51, 102, 153}
    shifted = move_image(image, Moves(shift=0.1), np.random.default_rng(1), interpolation="nearest")
    assert np.array_equal(np.sort(shifted.ravel()), np.sort(image.ravel())), "a shift alone loses nothing"


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"images": pictures()}, "no array 'labels', only images"),
        ({"images": pictures().astype(float), "labels": np.zeros(24, int)}, "must be .* uint8, got .* float64"),
        ({"images": pictures(), "labels": np.zeros(23, int)}, r"\[24, 12, 12\] images and \[23\] labels do not match"),
        ({"images": pictures(), "labels": np.full(24, 5)}, "label 5 has no name; class_names has 2"),
        ({"images": pictures(), "labels": np.full(24, -1)}, "numbers from 0 on"),
        ({"images": pictures(), "labels": np.array(["a", " "] * 12)}, "label 1 is an empty name"),
        ({"images": pictures(5), "labels": np.zeros(5, int)}, "expected 20 pictures or more, got 5"),
    ],
)
def test_bad_arrays(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(DataError, match=message):
        open_pictures(PictureOptions(root=tmp_path / "bad.npz", class_names=["cat", "dog"]))


def test_bad_places(tmp_path):
    with pytest.raises(DataError, match="no such file or folder"):
        open_pictures(PictureOptions(root=tmp_path / "none"))
    (tmp_path / "empty" / "cat").mkdir(parents=True)
    with pytest.raises(DataError, match="a class folder without pictures"):
        open_pictures(PictureOptions(root=tmp_path / "empty"))
    np.save(tmp_path / "pickled.npy", np.array([{"a": 1}], object), allow_pickle=True)
    (tmp_path / "pickled.npy").rename(tmp_path / "pickled.npz")
    with pytest.raises(DataError, match=r"pickled\.npz"):
        open_pictures(PictureOptions(root=tmp_path / "pickled.npz"))
    idx = write_idx(tmp_path / "idx", pictures(), np.zeros(24, np.uint8))
    cut = idx / "train-images-idx3-ubyte"
    cut.write_bytes(cut.read_bytes()[:-7])
    with pytest.raises(DataError, match="train-images-idx3-ubyte: expected number 0x803"):
        open_pictures(PictureOptions(root=idx))
    (idx / "train-labels-idx1-ubyte").unlink()
    with pytest.raises(DataError, match="expected train-labels-idx1-ubyte"):
        open_pictures(PictureOptions(root=idx))


def test_pictures_that_have_changed_are_opened_anew(tmp_path):
    def age(root):  # whatever the resolution of the file system's clock
        for place in (root, *root.rglob("*")):
            os.utime(place, (1, 1))

    root = write_folders(tmp_path / "folders", pictures(), ["cat", "dog"] * 12)
    age(root)
    assert len(open_pictures(PictureOptions(root=root))) == 24
    (root / "dog" / "001.png").unlink()
    assert len(open_pictures(PictureOptions(root=root))) == 23
    idx = write_idx(tmp_path / "idx", pictures(), np.zeros(24, np.uint8))
    age(idx)
    open_pictures(PictureOptions(root=idx))
    write_idx(idx, pictures() // 2, np.zeros(24, np.uint8))
    assert open_pictures(PictureOptions(root=idx)).images.max() < 128


@pytest.mark.parametrize("layout", ["npz", "gz"])
def test_damaged_files_are_named(tmp_path, layout):
    images, labels = pictures(), np.arange(24, dtype=np.uint8)
    if layout == "npz":
        root = file = tmp_path / "a.npz"
        np.savez_compressed(file, images=images, labels=labels)
    else:
        root = write_idx(tmp_path / "a", images, labels, packed=True)
        file = root / "train-images-idx3-ubyte.gz"
    whole = file.read_bytes()
    refused = 0
    for place in range(0, len(whole), 5):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 0x5A]) + whole[place + 1 :])
        try:
            _open(root, (), ((place, 0),))
        except DataError as error:
            refused += str(error).startswith(str(file))
    assert refused > len(whole) / 10


def test_an_archive_that_claims_more_than_it_holds_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    header = io.BytesIO()
    shape = (10**7, 1000, 1000)
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": shape})
    np.savez(path, labels=np.zeros(24, np.uint8))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("images.npy", header.getvalue() + bytes(100))
    with pytest.raises(DataError, match=r"a\.npz: images\.npy: not a complete NumPy file: shape .* got 100"):
        open_pictures(PictureOptions(root=path))


def test_an_array_larger_than_the_limit_is_not_read(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", images=np.zeros((24, 50, 50), np.uint8), labels=np.zeros(24, np.uint8))
    monkeypatch.setattr(labelled_pictures, "MAX_BYTES", 50_000)
    with pytest.raises(DataError, match=r"a\.npz: images\.npy has 60128 bytes, more than the limit of 50000"):
        open_pictures(PictureOptions(root=tmp_path / "a.npz"))


def test_a_file_that_is_no_picture_is_named(tmp_path):
    root = write_folders(tmp_path / "p", pictures(), ["cat", "dog"] * 12)
    (root / "cat" / "000.png").write_bytes(b"no picture")
    found = open_pictures(PictureOptions(root=root))
    with pytest.raises(DataError, match=r"000\.png: cannot be read as a picture"):
        found.read(0, 8)


def test_a_damaged_picture_that_claims_too_many_pixels_is_named(tmp_path):
    path = tmp_path / "a.bmp"
    cv2.imwrite(str(path), np.zeros((8, 8, 4), np.uint8))
    content = bytearray(path.read_bytes())
    content[18:26] = struct.pack("<ii", 1 << 21, 1 << 21)  # width and height
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.bmp: cannot be read as a picture"):
        read_picture(path)
    with pytest.raises(DataError, match=r"a\.bmp: expected a picture of 8 x 8 px, got none"):
        read_grey_pictures([path], (8, 8))
    with pytest.raises(DataError, match=r"a\.bmp: expected four time slices \[8, 8, 4\] of 8 bits, got no picture"):
        read_event_images([path], 8)


def test_bad_options(tmp_path):
    with pytest.raises(ValidationError, match="sum to 1"):
        PictureOptions(styles={"lines": 0.5})
    with pytest.raises(ValidationError, match="different and not empty"):
        PictureOptions(class_names=["a", "a"])
    np.savez(tmp_path / "n.npz", images=pictures(), labels=np.array(["cat", "dog"] * 12))
    with pytest.raises(DataError, match="synonyms of 'bird', which no picture shows; there are: cat, dog"):
        open_pictures(PictureOptions(root=tmp_path / "n.npz", synonyms={"bird": ["fowl"]}))
