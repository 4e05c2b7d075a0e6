"""Body files in SMPL's published layout, of random numbers: the recorded ones may not be passed on."""

from __future__ import annotations

import io
import pickle
import struct
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, cast

import numpy as np
import scipy.sparse

from ctlev_core.geometry.joint_sets import SMPL_PARENTS
from ctlev_core.stand_ins.dataset_writers import smpl_pickle as pickled

__all__ = ["chumpy_classes", "pickled", "pickled_by_python_2", "smpl_arrays", "sparse"]


def smpl_arrays(seed: int = 0, num_vertices: int = 6890, num_faces: int = 13776) -> dict[str, Any]:
    """Arrays with the names, shapes and types of SMPL's files; the regressor dense."""
    rng = np.random.default_rng(seed)
    weights = np.zeros((num_vertices, 24))
    for vertex in weights:
        vertex[rng.choice(24, 4, replace=False)] = rng.dirichlet(np.ones(4))
    regressor = np.zeros((24, num_vertices))
    for joint in regressor:
        joint[rng.choice(num_vertices, 12, replace=False)] = rng.dirichlet(np.ones(12))
    return {
        "v_template": rng.uniform(-0.9, 0.9, (num_vertices, 3)),
        "f": rng.integers(0, num_vertices, (num_faces, 3)).astype(np.uint32),
        "weights": weights,
        "shapedirs": 0.02 * rng.normal(size=(num_vertices, 3, 10)),
        "posedirs": 0.003 * rng.normal(size=(num_vertices, 3, 207)),
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, *SMPL_PARENTS[1:]], range(24)], np.uint32),
    }


def pickled_by_python_2(tree: dict[str, Any]) -> bytes:
    """Protocol 2 as Python 2 wrote it: text and the bytes of arrays alike are strings of one byte a letter."""
    buffer = io.BytesIO()
    _Python2Pickler(buffer, 2).dump(tree)
    content = buffer.getvalue().replace(b"cnumpy._core.", b"cnumpy.core.")
    for form in (b"csc", b"csr", b"coo"):
        content = content.replace(b"scipy.sparse._" + form, b"scipy.sparse." + form)
    return content


class _Python2Pickler(cast(Any, pickle)._Pickler):
    dispatch: ClassVar[dict[type, Any]] = dict(cast(Any, pickle)._Pickler.dispatch)

    def save_string(self, text: str | bytes) -> None:
        content = text.encode("ascii") if isinstance(text, str) else text
        if len(content) < 256:
            self.write(pickle.SHORT_BINSTRING + bytes([len(content)]) + content)
        else:
            self.write(pickle.BINSTRING + struct.pack("<i", len(content)) + content)
        self.memoize(text)

    dispatch[str] = dispatch[bytes] = save_string


def sparse(matrix: np.ndarray, form: str = "csc") -> Any:
    """A scipy matrix of one of the forms csc, csr and coo."""
    return getattr(scipy.sparse, f"{form}_matrix")(matrix)


@contextmanager
def chumpy_classes() -> Iterator[types.SimpleNamespace]:
    """Classes with the names of chumpy's and a state as theirs, as long as the context is open."""
    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering", "chumpy.ch_ops")}
    classes = types.SimpleNamespace()
    for module, name in (
        ("chumpy.ch", "Ch"),
        ("chumpy.reordering", "Select"),
        ("chumpy.reordering", "Reshape"),
        ("chumpy.reordering", "transpose"),
        ("chumpy.ch_ops", "multiply"),
    ):
        made = type(name, (_Expression,), {"__module__": module})
        setattr(modules[module], name, made)
        setattr(classes, name, made)
    sys.modules.update(modules)
    try:
        yield classes
    finally:
        for name in modules:
            del sys.modules[name]


class _Expression:
    def __init__(self, **terms: Any) -> None:
        self.__dict__.update(
            _dirty_vars=set(terms), _itr=None, _make_dense=False, _make_sparse=False, _depends_on_deps={}, **terms
        )
