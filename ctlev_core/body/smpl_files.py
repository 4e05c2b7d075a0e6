"""SMPL's own body files, .pkl and .npz, read without running the code they may carry; poses of its successors.

The pickles were written by Python 2: the regressor of the joints is a sparse matrix of scipy, and some arrays of the
older files are expressions of the autodiff package chumpy, which no longer installs. Of both only the numbers are
taken (`safe_files.safe_pickle`); neither package is imported to read them.

    v_template     [6890, 3]        m, the mean shape in its rest pose
    f              [13776, 3]       the faces
    weights        [6890, 24]       of linear blend skinning
    shapedirs      [6890, 3, 10]    m per unit of beta; 300 in version 1.1
    J_regressor    [24, 6890]       joints from vertices
    kintree_table  [2, 24]          the parent of each joint, and the joint; the root's parent is 4294967295
    posedirs       [6890, 3, 207]   m per entry of the rotation matrices of joints 1 to 23, less the identity

Source: Loper et al., SMPL, ACM TOG 2015, and the files of smpl.is.tue.mpg.de (own licence); chumpy's `ch.py` and
`reordering.py` for what a pickled expression holds. Real files could not be tried here: they may not be passed on.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_PARENTS
from ctlev_core.safe_files import numpy_files, safe_pickle
from ctlev_core.safe_files.plain_unpickler import StandIn
from data_contracts.errors import DataError

REQUIRED = ("v_template", "f", "weights", "shapedirs", "J_regressor", "kintree_table")
OPTIONAL = ("posedirs",)

POSE_COLUMNS = {72: "SMPL", 156: "SMPL-H", 165: "SMPL-X"}
_NUM_SHARED = 66
"""Columns of the root and the 21 body joints, which all three have first and in the same order."""

_CHUMPY = {
    "chumpy.ch.Ch": "x",
    "chumpy.reordering.Select": "a",
    "chumpy.reordering.Reshape": "a",
    "chumpy.reordering.transpose": "a",
}
"""The expressions that hold or reorder numbers and calculate nothing, and what they call these."""
_SPARSE = tuple(
    f"scipy.sparse.{module}.{form}_{kind}"
    for form in ("csc", "csr", "coo")
    for module in (form, f"_{form}")
    for kind in ("matrix", "array")
)
_MAX_ELEMENTS = 2**28
_MAX_DEPTH = 8


def given_body_file(body: Path | None, where: str) -> list[Path]:
    """The SMPL file where one is given, for cache keys.

    Raises:
        DataError: no such file.
    """
    if body is None:
        return []
    if not body.is_file():
        raise DataError(f"{where}: {body}: no such file; expected an SMPL body (.pkl or .npz)")
    return [body]


def read_smpl_file(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an SMPL body file, dense, under SMPL's names.

    The kind of file is told by its first bytes, not by its name. An .npz may leave out `kintree_table`, for a body of
    one's own need not repeat SMPL's; the tree is the same for all.

    Returns:
        The arrays of the table above, float64, `f` and `kintree_table` int64 (the root's parent -1). Without
        `posedirs` where the file has none: the body then bends without correctives, and elbows and hips get thinner.
    Raises:
        DataError: no such file, damaged, it names code other than chumpy's and scipy's containers (which is not run),
            lacks an array, holds something else than numbers in one, or has another skeleton than SMPL.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            is_npz = file.read(2) == b"PK"
    except OSError as error:
        raise DataError(f"{path}: cannot be read as a body model: {error.strerror}") from error
    found = _read_npz(path) if is_npz else _read_pickle(path)
    arrays = {name: _numbers(value, f"{path}: {name}") for name, value in found.items()}
    arrays["f"] = _whole_numbers(arrays["f"], f"{path}: f")
    if "kintree_table" in arrays:
        arrays["kintree_table"] = _check_tree(arrays["kintree_table"], path)
    return arrays


def smpl_pose_from_smplh(pose: np.ndarray) -> np.ndarray:
    """Poses of SMPL-H or SMPL-X as poses of SMPL.

    SMPL's 24 joints are the root and 21 body joints, which SMPL-H and SMPL-X have first and in the same order, and two
    hands, which those have as fingers instead: the two hands are straight here (zero rotation). Jaw and eyes of SMPL-X
    are left out. Shape coefficients are another matter: those of the three models are not the same.

    Args:
        pose: [..., 156] of SMPL-H, [..., 165] of SMPL-X, or [..., 72] of SMPL itself; rad, axis-angle.
    Returns:
        [..., 72] float64.
    Raises:
        DataError: another number of columns.
    """
    pose = np.asarray(pose, dtype=np.float64)
    if pose.ndim == 0 or pose.shape[-1] not in POSE_COLUMNS:
        known = " or ".join(f"[..., {columns}] ({name})" for columns, name in POSE_COLUMNS.items())
        raise DataError(f"poses must be {known}, got {list(pose.shape)}")
    if pose.shape[-1] == 3 * len(SMPL_JOINTS):
        return pose.copy()
    smpl = np.zeros((*pose.shape[:-1], 3 * len(SMPL_JOINTS)))
    smpl[..., :_NUM_SHARED] = pose[..., :_NUM_SHARED]
    return smpl


def _read_npz(path: Path) -> dict[str, Any]:
    members = numpy_files.list_npz(path)
    wanted = [name for name in (*REQUIRED, *OPTIONAL) if name in members]
    _check_present(path, set(wanted) | {"kintree_table"}, members)
    return numpy_files.read_npz(path, wanted, "a body model")


def _read_pickle(path: Path) -> dict[str, Any]:
    try:
        loaded = safe_pickle.load(path, stand_ins=("chumpy.*", *_SPARSE))
    except DataError as error:
        raise DataError(f"{path}: cannot be read as a body model: {str(error).removeprefix(f'{path}: ')}") from None
    if not isinstance(loaded, dict):
        raise DataError(f"{path}: cannot be read as a body model: expected a dictionary, got {type(loaded).__name__}")
    _check_present(path, set(loaded), [str(name) for name in loaded])
    return {name: loaded[name] for name in (*REQUIRED, *OPTIONAL) if name in loaded}


def _check_present(path: Path, names: set[str], found: list[str]) -> None:
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        raise DataError(f"{path}: cannot be read as a body model: lacks {', '.join(missing)}; found {', '.join(found)}")


def _check_tree(table: np.ndarray, path: Path) -> np.ndarray:
    """The table with -1 as the root's parent."""
    if table.shape != (2, len(SMPL_JOINTS)):
        raise DataError(
            f"{path}: kintree_table must be [2, {len(SMPL_JOINTS)}], got {list(table.shape)}: not SMPL's "
            f"joints (SMPL-H has 52, SMPL-X 55)"
        )
    # -1 as an unsigned number of 32 bits, or of 64, rounded to a float on the way.
    table = np.where(table >= 2**32 - 1, -1, table)
    expected = np.array([SMPL_PARENTS, range(len(SMPL_JOINTS))])
    if not np.array_equal(table, expected):
        row, joint = np.argwhere(table != expected)[0]
        raise DataError(
            f"{path}: kintree_table is not SMPL's tree: [{row}, {joint}] is {table[row, joint]:g}, expected "
            f"{expected[row, joint]}"
        )
    return expected


def _whole_numbers(array: np.ndarray, where: str) -> np.ndarray:
    if not np.all((array == np.floor(array)) & (np.abs(array) < 2**62)):
        raise DataError(f"{where} must be whole numbers")
    return array.astype(np.int64)


def _numbers(value: Any, where: str, depth: int = 0) -> np.ndarray:
    """The dense array that a value of the file stands for, float64."""
    if depth > _MAX_DEPTH:
        raise DataError(f"{where} is an expression nested deeper than {_MAX_DEPTH} times")
    try:
        if isinstance(value, StandIn):
            state = value.state if isinstance(value.state, dict) else {}
            if value.name in _SPARSE:
                value = _dense(value.name.rsplit(".", 1)[1][:3], state)
            else:
                value = _evaluate(value.name, state, where, depth)
        array = np.asarray(value)
    except DataError:
        raise
    except Exception as error:  # the state is whatever the file says, and wrong ones fail in many ways
        raise DataError(f"{where} cannot be made an array: {type(error).__name__}: {error}") from error
    if array.dtype.kind not in "fiub" or array.ndim == 0:
        raise DataError(f"{where} must be an array of numbers, got {type(value).__name__} of {array.dtype}")
    return array.astype(np.float64)


def _evaluate(name: str, state: dict[str, Any], where: str, depth: int) -> np.ndarray:
    """The value of one of chumpy's expressions."""
    if name not in _CHUMPY:
        raise DataError(
            f"{where} is an expression that would have to be calculated ({name}); read are {', '.join(_CHUMPY)}. "
            f"Convert the file where chumpy runs: every value as numpy.array(value)"
        )
    if _CHUMPY[name] not in state:
        raise DataError(f"{where} is a {name} without its `{_CHUMPY[name]}`; it holds {', '.join(map(str, state))}")
    array = _numbers(state[_CHUMPY[name]], where, depth + 1)
    if name.endswith(".Select"):
        chosen = array.ravel()[np.asarray(state["idxs"])]
        return chosen.reshape(state["preferred_shape"]) if "preferred_shape" in state else chosen
    if name.endswith(".Reshape"):
        return array.reshape(state["newshape"])
    if name.endswith(".transpose"):
        return np.transpose(array, state.get("axes"))
    return array


def _dense(form: str, state: dict[str, Any]) -> np.ndarray:
    """A sparse matrix of scipy as a dense one; entries that are there twice add up."""
    rows, columns = (int(n) for n in state["_shape" if "_shape" in state else "shape"])
    if min(rows, columns) < 0 or rows * columns > _MAX_ELEMENTS:
        raise ValueError(f"a sparse matrix of the shape {[rows, columns]}")
    data = np.asarray(state["data"], dtype=np.float64)
    if form == "coo":
        row, column = state["coords"] if "coords" in state else (state["row"], state["col"])
    else:
        starts = np.asarray(state["indptr"])
        if len(starts) != (columns if form == "csc" else rows) + 1 or starts[0] != 0 or starts[-1] > len(data):
            raise ValueError(f"a sparse matrix whose rows or columns start at {starts.tolist()[:8]} ...")
        outer = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        inner, data = np.asarray(state["indices"])[: len(outer)], data[: len(outer)]
        row, column = (inner, outer) if form == "csc" else (outer, inner)
    row, column = np.asarray(row), np.asarray(column)
    for name, index, count in (("row", row, rows), ("column", column, columns)):
        if math.prod(index.shape) and (index.min() < 0 or index.max() >= count):
            raise ValueError(f"a sparse matrix with an entry in {name} {index.min()} .. {index.max()} of {count}")
    dense = np.zeros((rows, columns))
    np.add.at(dense, (row, column), data)
    return dense
