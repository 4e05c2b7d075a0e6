"""Ordinary labelled pictures: what things look like and are called. A base model learns from them, or they are
recorded.

Three layouts are read:

    a folder of class folders     ROOT/<class>/<picture>.png, .jpg, .jpeg, .bmp or .webp
    an .npz file                  `images` [N, H, W] or [N, H, W, 3] uint8 and `labels` [N], numbers or names
    MNIST's own files             ROOT/train-images-idx3-ubyte and ROOT/train-labels-idx1-ubyte, plain or .gz

Grey pictures get three equal channels, transparent ones a black background, and 16-bit ones their upper 8 bits. JPEGs
are turned upright, as their EXIF data says: cameras store what they see and how they were held.
"""

from __future__ import annotations

import functools
import gzip
import math
import struct
import unicodedata
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator

from ctlev_core.dataset_files.picture_files import read_stored
from ctlev_core.dataset_files.trees import check_inside, list_folder
from ctlev_core.events.decoding.array_files import read_array_header, read_items
from ctlev_core.pictures.image_moves import Moves, move_image
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError

Style = Literal["photo", "grey", "lines", "coloured lines", "motion"]


def _check_sum(styles: dict[Style, float]) -> dict[Style, float]:
    if abs(sum(styles.values()) - 1) > 1e-6:
        raise ValueError(f"the shares of styles must sum to 1, got {sum(styles.values()):g}")
    return styles


StyleShares = Annotated[dict[Style, Annotated[float, Field(ge=0)]], AfterValidator(_check_sum)]
"""How often pictures are shown in each style."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
IDX_IMAGES, IDX_LABELS = "train-images-idx3-ubyte", "train-labels-idx1-ubyte"
MAX_BYTES = 4 * 2**30
"""Of the pictures in one file, which are held in memory; a folder of class folders has no limit."""
MIN_PICTURES = 20
READING = 2
"""Of how files become pixels, in cache keys; 2: JPEGs are turned upright."""
EXPECTED = f"""expected one of
  ROOT/<class>/<picture>{"|".join(SUFFIXES)}
  FILE.npz with `images` [N, H, W] or [N, H, W, 3] uint8 and `labels` [N]
  ROOT/{IDX_IMAGES} and ROOT/{IDX_LABELS} (MNIST), plain or .gz"""


class PictureSource(Frozen):
    """Which pictures."""

    root: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="folder of class folders, .npz file or folder of MNIST's files; null = procedural pictures",
    )
    class_names: tuple[str, ...] = Field(
        default=(), description="names of the labels 0, 1, 2, ... where labels are numbers; empty = the numbers"
    )

    @field_validator("class_names")
    @classmethod
    def _names_are_names(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if any(not name.strip() for name in names) or len(set(names)) < len(names):
            raise ValueError(f"class_names must be different and not empty, got {list(names)}")
        return names


class PictureOptions(PictureSource, Moves):
    """Which pictures, in what styles, and how much each is moved about whenever it is shown."""

    synonyms: dict[str, list[str]] = Field(
        default_factory=dict, description="further names of a class, of which captions take one at random"
    )
    styles: StyleShares = Field(
        default={"photo": 0.2, "lines": 0.2, "motion": 0.6},
        description="shares of the styles that pictures are shown in: as they are, as outlines, or as what changes "
        "while they move in three random directions one after the other (red, green, blue); an event camera sees that",
    )
    bare_caption_share: float = Field(
        default=0.5, ge=0, le=1, description="captions that say the name and not the style"
    )
    shift: float = Field(default=0.08, ge=0, le=0.5, description="as a share of the side, along each axis")
    turn_deg: float = Field(default=8.0, ge=0, le=180, description="either way, about the centre")
    scale: float = Field(default=0.1, ge=0, lt=1, description="so much larger or smaller")


@dataclass(frozen=True, eq=False)
class LabelledPictures:
    """N pictures and the name of the class of each; those of a folder are read when they are asked for.

    Attributes:
        names: [N] class names.
        images: [N, H, W] or [N, H, W, 3] uint8, or None where `files` holds them.
        files: [N] picture files.
    """

    names: tuple[str, ...]
    images: np.ndarray | None = None
    files: tuple[Path, ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    @property
    def classes(self) -> tuple[str, ...]:
        """The different names, sorted."""
        return tuple(sorted(set(self.names)))

    def read(self, row: int, size: int) -> np.ndarray:
        """Picture `row` as [size, size, 3] uint8 RGB: whole, its longer side `size` px, the rest as its border.

        Raises:
            DataError: the file is no picture.
        """
        picture = read_picture(self.files[row]) if self.images is None else self.images[row]
        if picture.ndim == 2:
            picture = np.repeat(picture[..., None], 3, axis=2)
        return _fit(picture, size)


def open_pictures(options: PictureSource) -> LabelledPictures:
    """Look through the pictures that `options.root` names; those of a folder are listed, not read.

    Raises:
        DataError: none of the layouts, fewer than `MIN_PICTURES`, an empty class, or labels without names.
    """
    root = options.root
    assert root is not None
    # What does not change between calls is read once: by every stage of a plan, and every block of pictures.
    found = _open(root, options.class_names, _modified(root))
    synonyms = options.synonyms if isinstance(options, PictureOptions) else {}
    unknown = sorted(set(synonyms) - set(found.names))
    if unknown:
        raise DataError(f"{root}: synonyms of {unknown[0]!r}, which no picture shows; {_known(found.classes)}")
    return found


def picture_files(options: PictureSource) -> list[Path]:
    """What the content of the pictures is: the folder or file, for a cache key."""
    return [] if options.root is None else [options.root]


def move(picture: np.ndarray, options: PictureOptions, rng: np.random.Generator) -> np.ndarray:
    """The picture [H, W, 3] moved at random as `options` say; what comes into view has its border colour."""
    return move_image(picture, options, rng, interpolation="linear", border=border_colour(picture))


def border_colour(picture: np.ndarray) -> tuple[float, float, float]:
    """The median colour of the outermost pixels of [H, W, 3]."""
    border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    red, green, blue = np.median(border, axis=0).tolist()
    return red, green, blue


def read_picture(path: Path) -> np.ndarray:
    """[H, W, 3] uint8 RGB.

    Raises:
        DataError: it cannot be read as a picture.
    """
    import cv2

    # IMREAD_UNCHANGED keeps transparency, which JPEGs have none of, and ignores EXIF.
    read = read_stored(path, cv2.IMREAD_COLOR if _is_jpeg(path) else cv2.IMREAD_UNCHANGED)
    if read is None or read.size == 0:
        raise DataError(f"{path}: cannot be read as a picture")
    picture = np.asarray(read)
    if picture.dtype == np.uint16:
        picture = (picture // 256).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise DataError(f"{path}: expected 8 or 16 bits a channel, got {picture.dtype}")
    if picture.ndim == 2:
        return np.repeat(picture[..., None], 3, axis=2)
    if picture.shape[2] == 4:
        opaque = picture[..., 3:].astype(np.uint16)
        picture = ((picture[..., :3] * opaque + 127) // 255).astype(np.uint8)
    return np.ascontiguousarray(picture[..., ::-1])


def _is_jpeg(path: Path) -> bool:
    """By its content, for names may say otherwise; False where it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(2) == b"\xff\xd8"
    except OSError:
        return False


def _fit(picture: np.ndarray, size: int) -> np.ndarray:
    import cv2

    height, width = picture.shape[:2]
    scale = size / max(height, width)
    new = max(round(width * scale), 1), max(round(height * scale), 1)
    resized = cv2.resize(picture, new, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    if new == (size, size):
        return resized
    canvas = np.empty((size, size, 3), np.uint8)
    canvas[:] = np.round(border_colour(picture))
    top, left = (size - new[1]) // 2, (size - new[0]) // 2
    canvas[top : top + new[1], left : left + new[0]] = resized
    return canvas


def _modified(root: Path) -> tuple[tuple[int, int], ...]:
    """Times of change and sizes of the place and, of a folder, of what lies in it: a class folder's are its own."""
    try:
        found = [entry.stat() for entry in (root, *(sorted(root.iterdir()) if root.is_dir() else ()))]
    except OSError:
        return ()
    return tuple((status.st_mtime_ns, status.st_size) for status in found)


@functools.lru_cache(maxsize=4)
def _open(root: Path, class_names: tuple[str, ...], modified: tuple[tuple[int, int], ...]) -> LabelledPictures:
    if root.is_file() and root.suffix == ".npz":
        found = _open_npz(root, class_names)
    elif root.is_dir() and _idx_file(root, IDX_IMAGES) is not None:
        found = _open_idx(root, class_names)
    elif root.is_dir():
        found = _open_folders(root)
    else:
        problem = "not a file of pictures" if root.exists() else "no such file or folder"
        raise DataError(f"{root}: {problem}; {EXPECTED}")
    if len(found) < MIN_PICTURES:
        raise DataError(f"{root}: expected {MIN_PICTURES} pictures or more, got {len(found)}")
    return found


def _open_folders(root: Path) -> LabelledPictures:
    files: list[Path] = []
    names: list[str] = []
    for folder in list_folder(root):
        if not folder.is_dir():
            continue
        here = [check_inside(file, root) for file in list_folder(folder) if file.suffix.lower() in SUFFIXES]
        if not here:
            raise DataError(f"{folder}: a class folder without pictures; {EXPECTED}")
        files += here
        # What looks the same is the same class, however a file system composes its accents.
        names += [unicodedata.normalize("NFC", folder.name)] * len(here)
    if not files:
        raise DataError(f"{root}: no class folders; {EXPECTED}")
    return LabelledPictures(tuple(names), files=tuple(files))


def _open_npz(path: Path, class_names: Sequence[str]) -> LabelledPictures:
    try:
        with zipfile.ZipFile(path) as archive:
            members = {name.removesuffix(".npy"): name for name in archive.namelist()}
            for name in ("images", "labels"):
                if name not in members:
                    raise DataError(f"{path}: no array {name!r}, only {', '.join(members) or 'none'}; {EXPECTED}")
            images, labels = (_read_array(archive, members[name], path) for name in ("images", "labels"))
    except (DataError, MemoryError):
        raise
    except Exception as error:  # zipfile and zlib report damage as a dozen types
        raise DataError(f"{path}: cannot be read as .npz: {error}") from error
    return _checked(images, labels, class_names, str(path))


def _read_array(archive: zipfile.ZipFile, name: str, path: Path) -> np.ndarray:
    where, size = f"{path}: {name}", archive.getinfo(name).file_size
    if size > MAX_BYTES:
        raise DataError(f"{where} has {size} bytes, more than the limit of {MAX_BYTES}")
    with archive.open(name) as file:
        header = read_array_header(file, where, size)
        items = read_items(file, header.dtype, math.prod(header.shape), where)
    return items.reshape(header.shape, order="F" if header.fortran_order else "C")


def _open_idx(root: Path, class_names: Sequence[str]) -> LabelledPictures:
    paths = [_idx_file(root, name) for name in (IDX_IMAGES, IDX_LABELS)]
    if paths[1] is None or paths[0] is None:
        raise DataError(f"{root}: expected {IDX_LABELS} beside {IDX_IMAGES}; {EXPECTED}")
    images, labels = _read_idx(paths[0], 0x803), _read_idx(paths[1], 0x801)
    return _checked(images, labels, class_names, str(root))


def _idx_file(root: Path, name: str) -> Path | None:
    return next((path for path in (root / name, root / f"{name}.gz") if path.is_file()), None)


def _read_idx(path: Path, magic: int) -> np.ndarray:
    """One of MNIST's files: a magic number, sizes, and bytes, all big-endian (yann.lecun.com/exdb/mnist)."""
    try:
        with path.open("rb") as packed:
            if path.suffix == ".gz":
                with gzip.open(packed) as file:
                    data = file.read(MAX_BYTES)
            else:
                data = packed.read(MAX_BYTES)
        (found,) = struct.unpack_from(">I", data)
        shape = struct.unpack_from(f">{magic & 0xFF}I", data, 4)
    except (OSError, EOFError, struct.error, zlib.error) as error:
        raise DataError(f"{path}: cannot be read as MNIST's format: {error}") from error
    start = 4 + 4 * len(shape)
    if found != magic or len(data) - start != int(np.prod(shape, dtype=np.int64)):
        raise DataError(f"{path}: expected number {magic:#x} and {shape} bytes, got {found:#x} and {len(data) - start}")
    return np.frombuffer(data, np.uint8, offset=start).reshape(shape)


def _checked(images: np.ndarray, labels: np.ndarray, class_names: Sequence[str], where: str) -> LabelledPictures:
    if images.dtype != np.uint8 or images.ndim not in (3, 4) or (images.ndim == 4 and images.shape[3] != 3):
        raise DataError(
            f"{where}: images must be [N, H, W] or [N, H, W, 3] uint8, got {list(images.shape)} {images.dtype}"
        )
    if min(images.shape[1:3]) < 1 or labels.shape != images.shape[:1]:
        raise DataError(f"{where}: {list(images.shape)} images and {list(labels.shape)} labels do not match")
    if labels.dtype.kind == "U":
        names = tuple(unicodedata.normalize("NFC", str(name)) for name in labels)
        if not all(name.strip() for name in names):
            raise DataError(f"{where}: label {[bool(name.strip()) for name in names].index(False)} is an empty name")
        return LabelledPictures(names, images)
    if labels.dtype.kind not in "iu" or (len(labels) and labels.min() < 0):
        raise DataError(f"{where}: labels must be names, or numbers from 0 on, got {labels.dtype}")
    if class_names and len(labels) and labels.max() >= len(class_names):
        raise DataError(f"{where}: label {labels.max()} has no name; class_names has {len(class_names)}")
    names = tuple(str(class_names[number] if class_names else number) for number in labels.tolist())
    return LabelledPictures(names, images)


def _known(classes: Sequence[str]) -> str:
    return f"there are: {', '.join(classes)}"
