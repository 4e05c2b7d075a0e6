"""Torch's own weights files (.pt, .pth, .bin, .ckpt): the table of their tensors, without running their pickle.

`torch.load` runs a pickle; with `weights_only` it refuses the first Stable Diffusion checkpoints, because the training
state beside their weights names a class of PyTorch Lightning. Here the few names that weights files need stand for
plain data, any other is refused, and tensors become places in the file.

Source of the layout: `torch.serialization`: a zip archive, not compressed, with the pickle `data.pkl` and the bytes of
each storage in `data/<key>`.
"""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, cast

from ctlev_core.safe_files.bounded_reader import BoundedReader
from ctlev_core.safe_files.plain_unpickler import Marker, PlainUnpickler
from ctlev_core.safe_files.tensor_files import ITEM_BYTES, StoredTensor
from data_contracts.errors import DataError

MAX_PICKLE = 16 * 2**20
"""Of `data.pkl`, which holds names and shapes only: 1 MB for Stable Diffusion. A byte of it can become 64 in memory."""
_MAX_BYTE_ORDER = 16
_LOCAL_HEADER = struct.Struct("<4s5H3I2H")
_MAX_DIMENSIONS = 16


class _StorageType(Marker):
    def __init__(self, dtype: str) -> None:
        self.dtype = dtype


class _Storage(NamedTuple):
    dtype: str
    start: int
    items: int


class _Tensor(NamedTuple):
    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Dictionary(dict):
    """Stands in for `collections.OrderedDict`, whose attributes are not wanted."""


def _make_dictionary(*items: object) -> _Dictionary:
    if items:
        raise DataError("it makes an ordered dictionary in an unknown way")
    return _Dictionary()


def _rebuild_tensor(storage: object, offset: object, shape: object, strides: object, *_: object) -> _Tensor:
    """In the place of `torch._utils._rebuild_tensor_v2`; gradients and hooks are not wanted."""
    if not isinstance(storage, _Storage) or not isinstance(shape, tuple) or not isinstance(strides, tuple):
        raise DataError("it holds a tensor that is not made of a storage, a shape and strides")
    numbers = (offset, *shape, *strides)
    if (
        len(shape) != len(strides)
        or len(shape) > _MAX_DIMENSIONS
        or not all(type(n) is int and n >= 0 for n in numbers)
    ):
        raise DataError(f"it holds a tensor of shape {shape} with strides {strides}")
    return _Tensor(storage, cast(int, offset), shape, strides)


def _rebuild_parameter(tensor: object, *_: object) -> _Tensor:
    if not isinstance(tensor, _Tensor):
        raise DataError("it holds a parameter that is no tensor")
    return tensor


_STORAGE_TYPES = {
    "Double": "F64", "Float": "F32", "Half": "F16", "BFloat16": "BF16",
    "Long": "I64", "Int": "I32", "Short": "I16", "Char": "I8", "Byte": "U8", "Bool": "BOOL",
}  # fmt: skip


class _TorchUnpickler(PlainUnpickler):
    """Plain data, and tensors as places in the file."""

    GLOBALS: ClassVar[dict[str, Any]] = {
        **PlainUnpickler.GLOBALS,
        "collections.OrderedDict": _make_dictionary,
        "torch._utils._rebuild_tensor_v2": _rebuild_tensor,
        "torch._utils._rebuild_parameter": _rebuild_parameter,
        **{f"torch.{name}Storage": _StorageType(dtype) for name, dtype in _STORAGE_TYPES.items()},
    }
    dispatch: ClassVar[dict[int, Callable]] = dict(PlainUnpickler.dispatch)

    def __init__(self, reader: BoundedReader, max_bytes: int, storages: dict[str, tuple[int, int]]) -> None:
        super().__init__(reader, max_bytes)
        self._storages = storages

    def find_class(self, module: str, name: str) -> Any:
        """What stands in for a global; Lightning uses its callbacks' classes as keys, here they are their names."""
        if module.split(".")[0] in ("pytorch_lightning", "lightning"):
            return f"{module}.{name}"
        return super().find_class(module, name)

    def load_binpersid(self) -> None:
        """A storage: ('storage', type, key, device, number of items)."""
        entry = self.stack.pop()
        known = isinstance(entry, tuple) and len(entry) == 5 and entry[0] == "storage"
        if not known or not isinstance(entry[1], _StorageType) or not isinstance(entry[2], str):
            raise DataError("it refers to something that is no storage of tensors")
        if entry[2] not in self._storages:
            raise DataError(f"the storage data/{entry[2]} is missing")
        start, nbytes = self._storages[entry[2]]
        dtype, items = entry[1].dtype, entry[4]
        if type(items) is not int or items * ITEM_BYTES[dtype] != nbytes:
            raise DataError(f"the storage data/{entry[2]} of {items} items {dtype} has {nbytes} bytes")
        self.append(_Storage(dtype, start, items))

    def load_build(self) -> None:
        """The attributes of an ordered dictionary are dropped."""
        if isinstance(self.stack[-2], _Dictionary):
            self.stack.pop()
        else:
            super().load_build()

    dispatch[pickle.BINPERSID[0]] = load_binpersid
    dispatch[pickle.BUILD[0]] = load_build


def read_torch_table(path: Path) -> dict[str, StoredTensor]:
    """The tensors of a file that `torch.save` wrote, by name.

    Args:
        path: of a dictionary of tensors, or of a training state with such a dictionary under `state_dict`.
    Raises:
        DataError: damaged, compressed, of another byte order, without tensors, or its pickle names something that
            weights do not need; nothing of it was called.
    """
    try:
        loaded = _read_archive(path)
        if isinstance(loaded, dict) and isinstance(loaded.get("state_dict"), dict):
            loaded = loaded["state_dict"]
        found = loaded.items() if isinstance(loaded, dict) else ()
        tensors = {
            name: _stored(path, name, value)
            for name, value in found
            if isinstance(name, str) and isinstance(value, _Tensor)
        }
        if not tensors:
            raise DataError("holds no named tensors; expected a dictionary of them, or one under 'state_dict'")
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    except Exception as error:  # a damaged archive or pickle can raise nearly any error
        raise DataError(f"{path}: damaged or truncated: {type(error).__name__}: {error}") from error
    return tensors


def _stored(path: Path, name: str, tensor: _Tensor) -> StoredTensor:
    storage = tensor.storage
    start = storage.start + tensor.offset * ITEM_BYTES[storage.dtype]
    stored = StoredTensor(path, storage.dtype, tensor.shape, tensor.strides, start)
    if stored.stored_items and tensor.offset + stored.stored_items > storage.items:
        raise DataError(
            f"tensor {name!r} of shape {list(tensor.shape)} reaches beyond its storage of {storage.items} items"
        )
    return stored


def _read_archive(path: Path) -> Any:
    size = path.stat().st_size
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        pickles = [name for name in archive.namelist() if name == "data.pkl" or name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise DataError(f"no weights archive of torch: it holds {len(pickles)} files data.pkl, expected one")
        prefix = pickles[0].removesuffix("data.pkl")
        order = f"{prefix}byteorder"
        if order in archive.namelist() and _read_member(archive, order, _MAX_BYTE_ORDER) != b"little":
            raise DataError("its tensors are not in little-endian byte order")
        storages = {}
        for entry in archive.infolist():
            if entry.filename.startswith(f"{prefix}data/"):
                if entry.compress_type != zipfile.ZIP_STORED:
                    raise DataError(f"{entry.filename} is compressed; torch does not do that")
                start = _content_start(file, entry)
                if start + entry.file_size > size:
                    raise DataError(f"truncated: {entry.filename} ends at byte {start + entry.file_size} of {size}")
                storages[entry.filename.removeprefix(f"{prefix}data/")] = (start, entry.file_size)
        content = _read_member(archive, pickles[0], MAX_PICKLE)
    return _TorchUnpickler(BoundedReader(io.BytesIO(content), len(content)), MAX_PICKLE, storages).load()


def _read_member(archive: zipfile.ZipFile, name: str, max_bytes: int) -> bytes:
    entry = archive.getinfo(name)
    if entry.compress_type != zipfile.ZIP_STORED:
        raise DataError(f"{name} is compressed; torch does not do that")
    if entry.file_size > max_bytes:
        raise DataError(f"{name} has {entry.file_size} bytes, at most {max_bytes} are read")
    return archive.read(entry)


def _content_start(file: Any, entry: zipfile.ZipInfo) -> int:
    """Of an entry of the archive: its own header has another length than the directory's."""
    file.seek(entry.header_offset)
    fields = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
    if fields[0] != b"PK\x03\x04":
        raise DataError(f"{entry.filename}: no entry where the archive's directory says")
    return entry.header_offset + _LOCAL_HEADER.size + fields[-2] + fields[-1]
