"""An unpickler that makes plain data and nothing else; `ctlev_core.safe_files.safe_pickle` reads files with it.

A pickle is a program. Here it may build dicts, lists, tuples, sets, numbers, strings, bytes, None, and NumPy arrays
and scalars of plain types (bool, int, float, complex, bytes, str). The globals a file names are never imported:
stand-ins of the few that such data needs take their place. Every other global, instruction or state is a `DataError`.
A caller may name classes of which it wants the state: a `StandIn` then holds that, itself plain data.
Arrays are built from checked shapes and sizes, because NumPy itself trusts the state a file gives, and nothing is
allocated for bytes that a file claims but does not hold.

Source of the layout: PEP 307, 3154 and 574, CPython's `pickle` module, NumPy's `__reduce_ex__`.
"""

from __future__ import annotations

import math
import pickle
import re
import reprlib
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np

from ctlev_core.safe_files.bounded_reader import BoundedReader
from data_contracts.errors import DataError

_PLAIN_DTYPE = re.compile(r"[<>=|]?(\?|[biufc]\d{1,2}|[SU]\d{1,9})")
_PLAIN_TYPES = (dict, list, tuple, set, frozenset, str, bytes, bytearray, int, float, complex, type(None))
_KEY_TYPES = (str, bytes, int, float, complex, type(None), np.generic)
_MAX_DIMENSIONS = 32


class Marker:
    """A class that a file may name but not call."""


NDARRAY = Marker()
_OBJECT = Marker()


@dataclass(eq=False)
class StandIn:
    """In the place of an object whose class was named as wanted: what the file says about it, and none of its code.

    Attributes:
        name: of the class, as `module.Class`.
        state: what the class would have got to restore itself from; None where the file gives none.
    """

    name: str
    state: Any = None


class _StandInClass(Marker):
    """A class in whose place `StandIn`s are made."""

    def __init__(self, name: str) -> None:
        self.name = name


class _Dtype:
    """A dtype under construction: the plain kinds only, because NumPy trusts the state of the others."""

    def __init__(self, spec: object, *_: object) -> None:
        text = spec.decode("ascii", "replace") if isinstance(spec, bytes) else spec
        if not isinstance(text, str) or not _PLAIN_DTYPE.fullmatch(text):
            raise DataError(
                f"it holds an array of type {reprlib.repr(spec)}; read are bool, int, float, complex, bytes and str"
            )
        self.dtype = np.dtype(text)

    def set_state(self, state: Any) -> None:
        """State as NumPy writes it: (version, byte order, subarray, names, fields, size, alignment, flags, ...)."""
        if not isinstance(state, tuple) or len(state) < 5 or any(part is not None for part in state[2:5]):
            raise DataError(
                f"it holds an array type with the state {reprlib.repr(state)}; structured types are not read"
            )
        order = state[1].decode("ascii", "replace") if isinstance(state[1], bytes) else state[1]
        if order not in ("<", ">", "|", "="):
            raise DataError(f"it holds an array type with the byte order {reprlib.repr(order)}")
        if order in "<>":
            self.dtype = self.dtype.newbyteorder(order)


def dtype_of(value: object) -> np.dtype:
    """The dtype that a file describes."""
    if not isinstance(value, _Dtype):
        raise DataError(f"it gives {type(value).__name__} where an array type belongs")
    return value.dtype


def count_bytes(shape: object, dtype: np.dtype) -> int:
    """Bytes of an array, after checking its shape."""
    plain = isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape)
    if not plain or len(cast(tuple, shape)) > _MAX_DIMENSIONS:
        raise DataError(f"it holds an array of the shape {reprlib.repr(shape)}")
    return math.prod(cast(tuple, shape)) * dtype.itemsize


def array_of(dtype: np.dtype, content: bytes | bytearray, shape: tuple[int, ...], order: Any = "C") -> np.ndarray:
    """A writable array of its bytes, in the byte order of this machine."""
    flat: Any = np.ndarray((math.prod(shape),), dtype, bytearray(content))
    return flat.astype(dtype.newbyteorder("="), copy=False).reshape(shape, order=order)


def _bytes_of(value: object) -> bytes | bytearray:
    if isinstance(value, str):  # of Python 2
        return value.encode("latin1")
    if not isinstance(value, bytes | bytearray):
        raise DataError(f"it gives {type(value).__name__} where the bytes of an array belong")
    return value


def _encode(text: object, encoding: object) -> bytes:
    """How Python 3 writes bytes in protocols 0 to 2."""
    if not isinstance(text, str) or encoding != "latin1":
        raise DataError(f"it encodes {type(text).__name__} as {reprlib.repr(encoding)}")
    return text.encode("latin1")


def _empty_bytes() -> bytes:
    """How Python 3 writes b"" in protocols 0 to 2."""
    return b""


def _set(items: object) -> set:
    """How protocols 0 to 3 write a set."""
    if not isinstance(items, list):
        raise DataError("it makes a set of something else than a list")
    _check_keys(items)
    return set(items)


def _check_keys(keys: Iterable[object]) -> None:
    """A short pickle can build nested tuples whose hash takes for ever."""
    for key in keys:
        if not all(isinstance(part, _KEY_TYPES) for part in (key if isinstance(key, tuple) else (key,))):
            raise DataError(f"refused: a key of a dictionary or set is {reprlib.repr(key)}, no number or string")


def _complex(real: object, imaginary: object) -> complex:
    if not isinstance(real, float) or not isinstance(imaginary, float):
        raise DataError("it makes a complex number of something else than two numbers")
    return complex(real, imaginary)


# pickle's C unpickler has no hook for BUILD, where NumPy would trust the file; joblib builds on this class as well.
_BaseUnpickler = cast(Any, pickle)._Unpickler


class PlainUnpickler(_BaseUnpickler):
    """Reads one object; `load` returns it.

    Args:
        reader: the bytes of the file.
        max_bytes: limit of the bytes of all arrays together.
        stand_ins: classes, as `module.Class` or, for all of a package, `package.*`, of which a `StandIn` is made; none
            of them is imported.
    """

    GLOBALS: ClassVar[dict[str, Any]] = {
        "numpy.ndarray": NDARRAY,
        "numpy.dtype": _Dtype,
        "_codecs.encode": _encode,
        "builtins.bytes": _empty_bytes,
        "__builtin__.bytes": _empty_bytes,
        "builtins.set": _set,
        "__builtin__.set": _set,
        "builtins.complex": _complex,
        "__builtin__.complex": _complex,
    }
    ARRAY_MAKERS: ClassVar[dict[str, str]] = {
        "multiarray._reconstruct": "_reconstruct",
        "multiarray.scalar": "_scalar",
        "numeric._frombuffer": "_frombuffer",
    }
    dispatch: ClassVar[dict[int, Callable]] = dict(_BaseUnpickler.dispatch)

    def __init__(self, reader: BoundedReader, max_bytes: int, stand_ins: Collection[str] = ()) -> None:
        super().__init__(reader, encoding="latin1")
        self.reader = reader
        self._array_bytes_left = self._max_bytes = max_bytes
        self._unfilled: dict[int, np.ndarray] = {}
        makers = {
            f"{package}.{name}": getattr(self, method)
            for package in ("numpy.core", "numpy._core")
            for name, method in self.ARRAY_MAKERS.items()
        }
        self._globals = {**self.GLOBALS, **makers}
        if stand_ins:
            for module in ("copyreg", "copy_reg"):
                self._globals[f"{module}._reconstructor"] = _reconstruct_stand_in
            for module in ("builtins", "__builtin__"):
                self._globals[f"{module}.object"] = _OBJECT
        self._stand_ins = stand_ins

    def load(self) -> Any:
        """The object.

        Raises:
            DataError: it is not plain data. A damaged file raises nearly any other error as well.
        """
        loaded = super().load()
        _check_plain(loaded)
        if self._unfilled:
            raise DataError("it holds an array without content")
        return loaded

    def find_class(self, module: str, name: str) -> Any:
        """What stands in for a global."""
        meaning = self._globals.get(f"{module}.{name}")
        if meaning is None and self._is_wanted(f"{module}.{name}"):
            meaning = self._globals[f"{module}.{name}"] = _StandInClass(f"{module}.{name}")
        if meaning is None:
            wanted = ", ".join(["plain data", *sorted(self._stand_ins)])
            raise DataError(f"refused: it names {module}.{name}, and only {wanted} and NumPy arrays are read")
        return meaning

    def _is_wanted(self, name: str) -> bool:
        return any(name == one or (one.endswith(".*") and name.startswith(one[:-1])) for one in self._stand_ins)

    def load_reduce(self) -> None:
        """Call a function: one of the stand-ins."""
        arguments = self.stack.pop()
        function = self.stack[-1]
        # By identity: an array on the stack would compare element by element.
        if not any(function is meaning for meaning in self._globals.values()) or isinstance(function, Marker):
            raise DataError(f"refused: it calls {type(function).__name__}, which makes no plain data")
        self.stack[-1] = function(*arguments)

    def load_build(self) -> None:
        """Give an object its state: an array or its type."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, _Dtype):
            target.set_state(state)
        elif isinstance(target, StandIn) and target.state is None:
            target.state = state
        elif id(target) in self._unfilled:
            self._fill(self._unfilled.pop(id(target)), state)
        else:
            raise DataError(f"refused: it sets the state of {type(target).__name__}")

    def load_newobj(self) -> None:
        """How protocols 2 and later make an object: here a stand-in, of the classes that were named as wanted."""
        arguments = self.stack.pop()
        if not isinstance(self.stack[-1], _StandInClass) or arguments != ():
            self.refuse()
        self.stack[-1] = StandIn(self.stack[-1].name)

    def load_bytearray8(self) -> None:
        """A bytearray; pickle's own allocates it before it looks whether the bytes are there."""
        self.append(bytearray(self.read(int.from_bytes(self.read(8), "little"))))

    def load_setitem(self) -> None:
        """One item of a dictionary."""
        _check_keys(self.stack[-2:-1])
        super().load_setitem()

    def load_setitems(self) -> None:
        """Items of a dictionary, keys and values in turns."""
        _check_keys(self.stack[::2])
        super().load_setitems()

    def load_dict(self) -> None:
        """A dictionary of protocol 0."""
        _check_keys(self.stack[::2])
        super().load_dict()

    def load_additems(self) -> None:
        """Items of a set."""
        _check_keys(self.stack)
        super().load_additems()

    def load_frozenset(self) -> None:
        """A set that stays as it is."""
        _check_keys(self.stack)
        super().load_frozenset()

    def refuse(self) -> None:
        """In the place of every instruction that makes objects of classes, or asks for data outside the file."""
        raise DataError("refused: it uses a pickle instruction that plain data does not need")

    dispatch[pickle.REDUCE[0]] = load_reduce
    dispatch[pickle.BUILD[0]] = load_build
    dispatch[pickle.NEWOBJ[0]] = load_newobj
    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8
    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems
    dispatch[pickle.DICT[0]] = load_dict
    dispatch[pickle.ADDITEMS[0]] = load_additems
    dispatch[pickle.FROZENSET[0]] = load_frozenset
    for _opcode in ("INST", "OBJ", "NEWOBJ_EX", "PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4"):
        dispatch[getattr(pickle, _opcode)[0]] = refuse
    for _opcode in ("NEXT_BUFFER", "READONLY_BUFFER"):
        dispatch[getattr(pickle, _opcode)[0]] = refuse

    def claim(self, nbytes: int) -> None:
        """Count the bytes of an array: a short pickle can ask for copies of the same content again and again."""
        if nbytes > self._array_bytes_left:
            raise DataError(f"its arrays have more bytes than the limit of {self._max_bytes}")
        self._array_bytes_left -= nbytes

    def _reconstruct(self, subtype: object, *_: object) -> np.ndarray:
        if subtype is not NDARRAY:
            raise DataError("refused: it holds an array that is no plain numpy.ndarray")
        array = np.empty(0, np.int8)
        self._unfilled[id(array)] = array
        return array

    def _fill(self, array: np.ndarray, state: Any) -> None:
        """Fill the array that `_reconstruct` made, in place: other objects may refer to it already."""
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise DataError(f"it holds an array with a state of {type(state).__name__}")
        shape, kind, fortran, raw = state[-4:]
        dtype, content = dtype_of(kind), self._content(shape, kind, raw)
        array.__setstate__((1, shape, dtype, cast(Any, bool(fortran)), bytes(content)))

    def _content(self, shape: object, kind: object, raw: object) -> bytes | bytearray:
        dtype, content = dtype_of(kind), _bytes_of(raw)
        expected = count_bytes(shape, dtype)
        if len(content) != expected:
            raise DataError(f"it holds an array {shape} of {dtype} with {len(content)} bytes instead of {expected}")
        self.claim(expected)
        return content

    def _scalar(self, kind: object, raw: object) -> Any:
        content = self._content((), kind, raw)
        if not content:  # an empty string has no bytes to point at
            return np.zeros((), dtype_of(kind))[()]
        return np.ndarray((), dtype_of(kind), bytes(content))[()]

    def _frombuffer(self, raw: object, kind: object, shape: Any, order: Any, axis_order: Any = None) -> np.ndarray:
        """How protocol 5 writes an array; NumPy from 2.3 on gives the order of its axes with `K`."""
        if order == "K" and axis_order is not None:
            return array_of(dtype_of(kind), self._content(shape, kind, raw), shape).transpose(axis_order)
        return array_of(dtype_of(kind), self._content(shape, kind, raw), shape, order)


def _reconstruct_stand_in(kind: object, base: object, state: object) -> StandIn:
    """How protocols 0 and 1 make an object."""
    if not isinstance(kind, _StandInClass) or base is not _OBJECT or state is not None:
        raise DataError("refused: it makes an object that is not plain data")
    return StandIn(kind.name)


def _check_plain(loaded: object) -> None:
    """Raise `DataError` where the result holds more than plain data, arrays and stand-ins that were asked for."""
    waiting, seen = [loaded], set()
    while waiting:
        value = waiting.pop()
        if isinstance(value, np.ndarray | np.generic) or id(value) in seen:
            continue
        if isinstance(value, StandIn):
            seen.add(id(value))
            waiting.append(value.state)
        elif not isinstance(value, _PLAIN_TYPES):
            raise DataError(f"refused: it holds something that is no plain data ({type(value).__name__})")
        if isinstance(value, dict | list | tuple | set | frozenset):
            seen.add(id(value))
            waiting.extend(value)
        if isinstance(value, dict):
            waiting.extend(value.values())
