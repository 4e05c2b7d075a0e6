"""Folders of downloaded datasets: found where they should be, listed safely, and errors that show the expected tree."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from data_contracts.errors import DataError, DetailedDataError

T = TypeVar("T")

ARCHIVES = (".zip", ".7z", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".rar")
MAX_SEARCHED = 50
"""Folders in which the root is looked for: an error message must not search a home folder."""
_NOT_IN_IDS = re.compile(r"[^A-Za-z0-9._-]+")


def check_root(root: Path, tree: str, is_root: Callable[[Path], bool]) -> Path:
    """The root of a dataset.

    Args:
        root: what the user gave.
        tree: the expected tree, for the error.
        is_root: does a folder look like the root?
    Raises:
        DetailedDataError: no such folder, or it is not the root: one level too high or too low, not unpacked, or
            something else; the message says which, and shows the tree.
    """
    if not root.is_dir():
        problem = "a file, not a folder" if root.exists() else "no such folder"
        raise DetailedDataError(f"{root}: {problem}; {tree}")
    if is_root(root):
        return root
    entries = _visible_entries(root)
    folders = [entry for entry in entries if entry.is_dir()]
    below = [folder for parent in folders[:MAX_SEARCHED] for folder in _folders_in(parent)]
    for candidate in [*folders, *below][:MAX_SEARCHED]:
        if _may_be_root(candidate, is_root):
            raise DetailedDataError(f"{root}: not the dataset itself; the root is {candidate}; {tree}")
    for parent in list(root.resolve().parents)[:2]:
        if _may_be_root(parent, is_root):
            raise DetailedDataError(f"{root}: lies inside the dataset; the root is {parent}; {tree}")
    packed = [entry.name for entry in entries if entry.suffix.lower() in ARCHIVES]
    if packed:
        raise DetailedDataError(f"{root}: holds archives that are not unpacked ({', '.join(packed[:3])}); {tree}")
    raise DetailedDataError(f"{root}: not the expected folder; {tree}")


def _may_be_root(folder: Path, is_root: Callable[[Path], bool]) -> bool:
    """What is wrong in a folder that nobody named is no reason not to say what is wrong with the one they did."""
    try:
        return is_root(folder)
    except DataError:
        return False


def _folders_in(folder: Path) -> list[Path]:
    try:
        return [entry for entry in _visible_entries(folder) if entry.is_dir()]
    except DataError:
        return []


def _visible_entries(folder: Path) -> list[Path]:
    try:
        return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise DataError(f"{folder}: the folder cannot be read: {error.strerror}") from error


def list_folder(folder: Path) -> list[Path]:
    """Entries that are not hidden, sorted by name.

    Raises:
        DataError: the folder cannot be read, or a link in it leads nowhere.
    """
    entries = _visible_entries(folder)
    for entry in entries:
        if entry.is_symlink() and not entry.exists():
            raise DataError(f"{entry}: a link to nothing")
    return entries


def check_inside(path: Path, root: Path) -> Path:
    """Raise `DataError` where a link leads out of the root: a dataset is what lies in its folder."""
    if path.is_symlink() and not path.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{path}: links to {path.resolve()}, outside the dataset folder {root}")
    return path


def list_files(folder: Path, root: Path, suffix: str) -> list[Path]:
    """Files of one kind in a folder, sorted by name; others are left alone.

    Raises:
        DataError: there are none, or one is a link out of the root.
    """
    files = [entry for entry in list_folder(folder) if entry.suffix.lower() == suffix and not entry.is_dir()]
    if not files:
        raise DataError(f"{folder}: expected *{suffix} files, found none")
    return [check_inside(file, root) for file in files]


def read_lines(file: Path) -> list[tuple[int, str]]:
    """Numbers, from 1 on, and contents of the lines of a text file that are not blank, without spaces around them.

    Raises:
        DataError: the file cannot be read, or is no UTF-8 text.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{file}: cannot be read as text: {error}") from error
    return [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]


def check_name(path: Path) -> str:
    """The name of a file without suffix, or of a folder, as part of a recording id.

    Raises:
        DataError: it has other characters than letters, digits, `.`, `_` and `-`.
    """
    name = path.stem if path.is_file() else path.name
    if _NOT_IN_IDS.search(name):
        raise DataError(f"{path}: expected a name of letters, digits, '.', '_' and '-', got {name!r}")
    return name


def recording_ids(paths: Iterable[Path], root: Path) -> list[str]:
    """Recording ids of files with free names: the paths within the root without suffix.

    Letters of other alphabets become their code points (`ue4` for an a with two dots), so that names in them stay
    apart; blanks and signs become `_`.

    Raises:
        DataError: two files get the same id.
    """
    owners: dict[str, Path] = {}
    for path in paths:
        parts = path.relative_to(root).with_suffix("").parts
        name = "/".join(_NOT_IN_IDS.sub(_in_ascii, unicodedata.normalize("NFC", part)) for part in parts)
        if name in owners:
            raise DataError(f"{path}: would get the recording id {name!r} of {owners[name]}; rename one of them")
        owners[name] = path
    return list(owners)


def _in_ascii(found: re.Match[str]) -> str:
    return re.sub("_+", "_", "".join(f"u{ord(letter):x}" if letter.isalnum() else "_" for letter in found.group()))


def shuffled(names: Iterable[str], seed: int, *salt: str) -> list[str]:
    """The names in a random order that depends on each name, the seed and the salt alone: the order of their hashes.

    Taking the first n of it is a choice that grows with n: the choice of 50 is part of the choice of 100. A file more
    or less, another listing order or another version of NumPy changes the place of no other name.
    """
    start = hashlib.sha256("\0".join([str(seed), *salt, ""]).encode())

    def order(name: str) -> bytes:
        digest = start.copy()
        digest.update(name.encode())
        return digest.digest()

    return sorted(names, key=order)


def first_of(items: Sequence[T], count: int | None) -> list[T]:
    """The first `count` items, all of them where `count` is None."""
    return list(items) if count is None else list(items[:count])
