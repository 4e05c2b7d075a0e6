"""Objects of HDF5 files, found without following what leads out of the file, and bounded before they are read.

An HDF5 file may name others: links to objects in them (external links), raw bytes as values of a dataset (external
storage), or datasets put together from theirs (virtual datasets). A file from elsewhere could show any file of this
machine that way, so all three are refused. A chunk is decompressed as a whole whatever is read of it, so its size is
limited.
"""

from __future__ import annotations

import math
from typing import Any

from data_contracts.errors import DataError

MAX_CHUNK_BYTES = 128 * 2**20
"""Decompressed. Writers choose a MiB or so; `h5repack -l` writes a file with others."""
MAX_COMPRESSION = 1 << 20
"""Bytes of values a stored byte may stand for."""
_DEFAULT_CACHE_BYTES = 2**20
_MAX_SOFT_LINKS = 8


def find_object(group: Any, name: str, where: str) -> Any:
    """The group or dataset of a name, which may have several parts; None where there is none.

    Args:
        group: an open h5py file or group.
        name: its path; "/" is the group itself.
        where: names the file in messages.
    Raises:
        DataError: an external link lies on the way, or soft links go in circles.
    """
    return _find(group, name, where, _MAX_SOFT_LINKS)


def _find(group: Any, name: str, where: str, soft_links: int) -> Any:
    import h5py

    found: Any = group.file if name.startswith("/") and name != "/" else group
    for part in filter(None, name.split("/")):
        link = found.get(part, getlink=True) if isinstance(found, h5py.Group) else None
        if link is None:
            return None
        if isinstance(link, h5py.ExternalLink):
            raise DataError(f"{where}: {name[:80]} is a link to another file, {link.filename[:80]!r}; not followed")
        if isinstance(link, h5py.SoftLink):
            if not soft_links:
                raise DataError(f"{where}: {name[:80]} is a link to a link, and so on; not followed")
            found = _find(found, link.path, where, soft_links - 1)
        else:
            found = _open(found, part)
    return found


def _open(group: Any, name: str) -> Any:
    """What a hard link refers to; a dataset of large chunks with a cache that holds one of them.

    A chunk that the cache does not hold is decompressed anew for every block that is read of it.
    """
    import h5py

    found = group[name]
    if not isinstance(found, h5py.Dataset) or not _DEFAULT_CACHE_BYTES < _chunk_bytes(found) <= MAX_CHUNK_BYTES:
        return found
    access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
    access.set_chunk_cache(521, _chunk_bytes(found), 0.75)
    del found  # a dataset that is open keeps the cache it was opened with
    return h5py.Dataset(h5py.h5d.open(group.id, name.encode(), access))


def _chunk_bytes(dataset: Any) -> int:
    return math.prod(dataset.chunks) * dataset.dtype.itemsize if dataset.chunks else 0


def dataset_names(group: Any, where: str) -> list[str]:
    """Names of the datasets of a group.

    Raises:
        DataError: as `find_object`.
    """
    return [name for name in group if hasattr(find_object(group, name, where), "shape")]


def check_dataset(dataset: Any, where: str, max_bytes: int | None = None, rows: bool = False) -> Any:
    """The same dataset: it holds numbers that lie in this very file, in chunks of bounded size.

    Args:
        dataset: of h5py.
        where: names file and dataset in messages.
        max_bytes: of all its values; None where they are read in blocks.
        rows: a value is a row of named numbers.
    Raises:
        DataError: it does not; nothing was read.
    """
    types = [dataset.dtype[name] for name in dataset.dtype.names or ()] if rows else [dataset.dtype]
    if dataset.shape is None or not types or any(one.kind not in "buif" for one in types):
        raise DataError(f"{where}: expected numbers, got {dataset.dtype}")
    if dataset.external:
        raise DataError(f"{where}: its values are in another file, {dataset.external[0][0][:80]!r}; not read")
    if dataset.is_virtual:
        raise DataError(f"{where}: is put together from datasets of other files; not read")
    if max_bytes is not None and dataset.nbytes > max_bytes:
        raise DataError(f"{where}: {dataset.shape} values are {dataset.nbytes} bytes, at most {max_bytes} are read")
    if dataset.nbytes > MAX_COMPRESSION * dataset.id.get_storage_size():
        raise DataError(
            f"{where}: {dataset.shape} values declared, {dataset.id.get_storage_size()} bytes stored: incomplete"
        )
    if _chunk_bytes(dataset) > MAX_CHUNK_BYTES:
        raise DataError(
            f"{where}: chunks of {dataset.chunks} values are {_chunk_bytes(dataset)} bytes, at most {MAX_CHUNK_BYTES} "
            "are read at once; write it with smaller ones (h5repack -l)"
        )
    return dataset
