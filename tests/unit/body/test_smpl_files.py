"""SMPL's body files as published are read to the last bit; their code, lies and damage are refused."""

from __future__ import annotations

import contextlib
import os
import pickle

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from smpl_writers import chumpy_classes, pickled, pickled_by_python_2, smpl_arrays, sparse

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.body.smpl_files import read_smpl_file, smpl_pose_from_smplh
from ctlev_core.geometry.joint_sets import SMPL_PARENTS
from ctlev_core.safe_files import safe_pickle
from ctlev_core.safe_files.plain_unpickler import StandIn
from data_contracts.errors import DataError

SMALL = smpl_arrays(1, num_vertices=40, num_faces=50)


class RunsCode:
    """What a hostile file holds: unpickling it calls os.system."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def assert_read(path, expected):
    arrays = read_smpl_file(path)
    assert set(arrays) == set(expected)
    for name in expected:
        wanted = expected[name].astype(np.float64)
        if name == "kintree_table":
            wanted = np.array([SMPL_PARENTS, range(24)])
        np.testing.assert_array_equal(arrays[name], wanted, err_msg=name)


def write(path, tree):
    """As .pkl or .npz, by the ending."""
    if path.suffix == ".pkl":
        path.write_bytes(pickled(tree))
    else:
        np.savez(path, allow_pickle=True, **tree)


def refused(path, message):
    load_body.cache_clear()
    with pytest.raises(DataError, match=message) as error:
        load_body(path)
    assert str(error.value).startswith(str(path))


def test_a_full_size_file_as_published(tmp_path):
    arrays = smpl_arrays()
    tree = arrays | {"J_regressor": sparse(arrays["J_regressor"]), "bs_type": "lrotmin", "bs_style": "lbs"}
    (tmp_path / "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl").write_bytes(pickled(tree))
    path = tmp_path / "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl"
    assert_read(path, arrays)
    body = load_body(path)
    assert body.v_template.shape == (6890, 3) and body.weight_indices.shape == (6890, 4)
    np.testing.assert_allclose(body.joints, arrays["J_regressor"] @ arrays["v_template"], atol=1e-14)
    vertices, _ = pose_vertices(body, np.tile(np.eye(3), (1, 24, 1, 1)), np.zeros(10), np.zeros((1, 3)))
    np.testing.assert_allclose(vertices[0], arrays["v_template"], atol=1e-6)


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("form", ["csc", "csr", "coo"])
def test_sparse_regressors_of_every_form_and_protocol(protocol, form, tmp_path):
    tree = SMALL | {"J_regressor": sparse(SMALL["J_regressor"], form)}
    (tmp_path / "model.pkl").write_bytes(pickled(tree, protocol))
    assert_read(tmp_path / "model.pkl", SMALL)


def test_sparse_arrays_and_entries_that_are_there_twice(tmp_path):
    twice = scipy.sparse.coo_array(([0.25, 0.75, 1.0], ([0, 0, 1], [3, 3, 0])), shape=(24, 40))
    (tmp_path / "model.pkl").write_bytes(pickled(SMALL | {"J_regressor": twice}))
    np.testing.assert_array_equal(read_smpl_file(tmp_path / "model.pkl")["J_regressor"], twice.toarray())


def test_files_that_python_2_wrote(tmp_path):
    with chumpy_classes() as chumpy:
        tree = SMALL | {
            "weights": chumpy.Ch(x=SMALL["weights"]),
            "J_regressor": sparse(SMALL["J_regressor"]),
            "pose_training_info": {"gender": "x", "dirs": ["a" * 300]},
        }
        content = pickled_by_python_2(tree)
    assert b"scipy.sparse.csc\ncsc_matrix\n" in content
    assert b"U\rkintree_table" in content and b"encode" not in content
    (tmp_path / "model.pkl").write_bytes(content)
    assert_read(tmp_path / "model.pkl", SMALL)


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_files_with_expressions_of_chumpy(protocol, tmp_path):
    with chumpy_classes() as chumpy:
        shapedirs = np.concatenate([np.full((40, 3, 2), 7.0), SMALL["shapedirs"]], axis=2)
        indices = np.arange(shapedirs.size).reshape(shapedirs.shape)[..., 2:].ravel()
        tree = SMALL | {
            "v_template": chumpy.Ch(x=SMALL["v_template"]),
            "shapedirs": chumpy.Select(a=chumpy.Ch(x=shapedirs), idxs=indices, preferred_shape=(40, 3, 10)),
            "weights": chumpy.transpose(a=chumpy.Ch(x=SMALL["weights"].T), axes=None),
            "posedirs": chumpy.Reshape(a=chumpy.Ch(x=SMALL["posedirs"].ravel()), newshape=(40, 3, 207)),
            "J_regressor": sparse(SMALL["J_regressor"]),
        }
        (tmp_path / "model.pkl").write_bytes(pickled(tree, protocol))
    assert_read(tmp_path / "model.pkl", SMALL)


def test_a_calculation_of_chumpy_is_refused_by_name_where_it_is_needed(tmp_path):
    with chumpy_classes() as chumpy:
        tree = SMALL | {"shapedirs": chumpy.multiply(a=SMALL["shapedirs"], b=2.0)}
        (tmp_path / "model.pkl").write_bytes(pickled(tree))
        (tmp_path / "aside.pkl").write_bytes(pickled(SMALL | {"J": chumpy.multiply(a=1.0, b=2.0)}))
        (tmp_path / "empty.pkl").write_bytes(pickled(SMALL | {"shapedirs": chumpy.Ch()}))
        nested = chumpy.Ch(x=SMALL["shapedirs"])
        for _ in range(20):
            nested = chumpy.Ch(x=nested)
        (tmp_path / "nested.pkl").write_bytes(pickled(SMALL | {"shapedirs": nested}))
        itself = chumpy.Ch()
        itself.x = itself
        (tmp_path / "itself.pkl").write_bytes(pickled(SMALL | {"shapedirs": itself}))
    refused(tmp_path / "model.pkl", r"shapedirs is an expression that would .*\(chumpy\.ch_ops\.multiply\)")
    assert_read(tmp_path / "aside.pkl", SMALL)
    refused(tmp_path / "empty.pkl", r"shapedirs is a chumpy\.ch\.Ch without its `x`")
    refused(tmp_path / "nested.pkl", "nested deeper")
    refused(tmp_path / "itself.pkl", "nested deeper")


def test_code_in_a_file_is_not_run_wherever_it_hides(tmp_path):
    ran = tmp_path / "ran"
    trap = RunsCode(f"touch {ran}")
    regressor = sparse(SMALL["J_regressor"])
    regressor.extra = trap
    with chumpy_classes() as chumpy:
        trees = {
            "value": SMALL | {"v_template": trap},
            "aside": SMALL | {"readme": trap},
            "sparse": SMALL | {"J_regressor": regressor},
            "chumpy": SMALL | {"weights": chumpy.Ch(x=SMALL["weights"], also=trap)},
        }
        for name, tree in trees.items():
            for protocol in range(6):
                path = tmp_path / f"{name}{protocol}.pkl"
                path.write_bytes(pickled(tree, protocol))
                refused(path, r"it names posix\.system")
                assert not ran.exists()
        pickle.loads((tmp_path / "chumpy2.pkl").read_bytes())
    assert ran.exists(), "the trap of this test is set: an ordinary unpickler falls into it"


@pytest.mark.parametrize("ending", ["pkl", "npz"])
@pytest.mark.parametrize("name", [*SMALL, "f and weights"])
def test_missing_arrays_are_named_except_those_one_can_do_without(ending, name, tmp_path):
    tree = {key: array for key, array in SMALL.items() if key not in name.split(" and ")}
    path = tmp_path / f"model.{ending}"
    write(path, tree)
    if name == "posedirs":
        assert load_body(path).posedirs is None
        assert set(read_smpl_file(path)) == set(tree)
    elif name == "kintree_table" and ending == "npz":
        assert load_body(path).posedirs is not None
    else:
        refused(path, f"lacks {name.replace(' and ', ', ')}; found .*J_|lacks J_regressor; found .*weights")


@pytest.mark.parametrize("ending", ["pkl", "npz"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.full((40, 52), 1 / 52)}, r"weights must have the shape \(40, 24\), got \(40, 52\)"),
        ({"posedirs": np.zeros((40, 3, 459))}, r"posedirs must have the shape \(40, 3, 207\), got \(40, 3, 459\)"),
        ({"v_template": np.zeros((41, 3))}, "must have the shape"),
        ({"shapedirs": np.zeros((40, 3, 9))}, "shapedirs must have the shape"),
        ({"shapedirs": np.zeros(7)}, "shapedirs must have the shape"),
        (
            {"weights": np.zeros((40, 24))},
            "weights of a vertex must be non-negative with a sum of 1; those of vertex 0",
        ),
        ({"weights": np.tile([2.0, -1.0, *[0.0] * 22], (40, 1))}, "weights of a vertex must be non-negative"),
        ({"f": np.full((5, 3), 40)}, r"faces must name vertices 0 \.\. 39"),
        ({"f": np.full((5, 3), 0.5)}, "f must be whole numbers"),
        ({"posedirs": np.full((40, 3, 207), np.nan)}, "posedirs holds values that are not finite"),
        ({"kintree_table": np.zeros((2, 52), np.int64)}, r"kintree_table must be \[2, 24\], got \[2, 52\]"),
        ({"kintree_table": SMALL["kintree_table"][:, ::-1]}, r"not SMPL's tree: \[0, 0\] is 21, expected -1"),
        ({"v_template": np.array([["a", "b", "c"]] * 40)}, "v_template must be"),
        ({"v_template": np.float64(3.0)}, "v_template must be an array of numbers"),
    ],
)
def test_wrong_arrays_are_named(ending, change, message, tmp_path):
    path = tmp_path / f"model.{ending}"
    write(path, SMALL | change)
    refused(path, message)


def test_roots_of_the_tree_as_every_tool_writes_them(tmp_path):
    for root in (np.uint32(2**32 - 1), np.int64(-1), np.float64(2**32 - 1), np.uint64(2**64 - 1)):
        table = np.array([[root, *SMPL_PARENTS[1:]], range(24)], dtype=root.dtype)
        write(tmp_path / "model.npz", SMALL | {"kintree_table": table})
        assert read_smpl_file(tmp_path / "model.npz")["kintree_table"][0, 0] == -1


def test_values_that_are_no_arrays_are_named(tmp_path):
    for value in ("text", {"a": 1}, [1, [2, 3]], None):
        (tmp_path / "model.pkl").write_bytes(pickled(SMALL | {"v_template": value}))
        refused(tmp_path / "model.pkl", "v_template (must be an array of numbers|cannot be made an array)")


def test_object_arrays_in_an_npz_are_not_unpickled(tmp_path):
    ran = tmp_path / "ran"
    write(tmp_path / "model.npz", SMALL | {"J_regressor": np.array(RunsCode(f"touch {ran}"), object)})
    refused(tmp_path / "model.npz", "J_regressor: an array of Python objects, which only a pickle can hold")
    assert not ran.exists()
    # Those that nobody asks for stay unread.
    write(tmp_path / "more.npz", SMALL | {"bs_style": np.array({"a": 1}, object)})
    assert_read(tmp_path / "more.npz", SMALL)


@pytest.mark.parametrize(
    "change",
    [
        {"indices": np.full(5, 40, np.int32)},
        {"indices": np.full(5, -1, np.int32)},
        {"indptr": np.array([0, 5], np.int32)},
        {"indptr": np.arange(41, dtype=np.int32)},
        {"indptr": np.array([0, *[9] * 39, 5], np.int32)},
        {"_shape": (2**20, 2**20)},
        {"_shape": (-24, 40)},
        {"_shape": None},
        {"data": "text"},
    ],
)
def test_sparse_matrices_that_lie(change, tmp_path):
    regressor = sparse(np.zeros((24, 40)))
    regressor.data, regressor.indices = np.ones(5), np.zeros(5, np.int32)
    regressor.indptr = np.array([0, *[5] * 40], np.int32)
    for name, value in change.items():
        object.__setattr__(regressor, name, value)
    (tmp_path / "model.pkl").write_bytes(pickled(SMALL | {"J_regressor": regressor}))
    refused(tmp_path / "model.pkl", "J_regressor|sparse matrix")


def test_other_files_are_refused(tmp_path):
    refused(tmp_path / "absent.pkl", "cannot be read as a body model")
    refused(tmp_path, "cannot be read as a body model")
    for content in (b"", b"PK", b"PK\x03\x04broken", b"text", pickle.dumps([1, 2]), pickled(SMALL)[:-500]):
        (tmp_path / "model.pkl").write_bytes(content)
        refused(tmp_path / "model.pkl", "cannot be read as a body model")


@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_damaged_files_raise_data_errors(data, tmp_path_factory):
    tree = SMALL | {"J_regressor": sparse(SMALL["J_regressor"])}
    content = bytearray(pickled({name: tree[name] for name in ("J_regressor", "kintree_table", "f")}))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "fuzzed_model.pkl"
    path.write_bytes(bytes(content))
    with contextlib.suppress(DataError):
        read_smpl_file(path)


def test_stand_ins_are_made_of_named_classes_alone(tmp_path):
    path = tmp_path / "a.pkl"
    for protocol in range(6):
        path.write_bytes(pickle.dumps({"m": sparse(np.eye(2)), "n": [1]}, protocol))
        with pytest.raises(DataError, match=r"it names (scipy\.sparse\._csc\.csc_matrix|copy_?reg\._reconstructor)"):
            safe_pickle.load(path)
        loaded = safe_pickle.load(path, stand_ins=["scipy.sparse._csc.csc_matrix"])
        assert isinstance(loaded["m"], StandIn) and loaded["m"].name == "scipy.sparse._csc.csc_matrix"
        np.testing.assert_array_equal(loaded["m"].state["data"], [1.0, 1.0])
        with pytest.raises(DataError, match="it names scipy"):
            safe_pickle.load(path, stand_ins=["scipy.sparse.csc.csc_matrix", "scipy.sparse._csc.c", "scip.*", "*"])
        assert safe_pickle.load(path, stand_ins=["scipy.*"])["m"].name == "scipy.sparse._csc.csc_matrix"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ca\nB\n.", "no plain data"),
        (b"ca\nB\n(K\x01t\x81.", "instruction that plain data does not need"),
        (b"ca\nB\n)R.", "calls _StandInClass"),
        (b"ca\nB\n)\x81}b}b.", "sets the state of StandIn"),
        (b"ca\nB\n)\x81ca\nB\nb.", "no plain data"),
        (b"}ca\nB\n)\x81K\x01s.", "key of a dictionary"),
        (b"ccopy_reg\n_reconstructor\n(cnumpy\nndarray\nc__builtin__\nobject\nNtR.", "makes an object"),
    ],
)
def test_stand_ins_do_nothing_but_hold_a_state(content, message, tmp_path):
    (tmp_path / "a.pkl").write_bytes(content)
    with pytest.raises(DataError, match=message):
        safe_pickle.load(tmp_path / "a.pkl", stand_ins=["a.B"])


def test_poses_of_smplh_and_smplx_become_smpls():
    rng = np.random.default_rng(0)
    for columns in (156, 165):
        pose = rng.normal(size=(2, 5, columns))
        smpl = smpl_pose_from_smplh(pose)
        np.testing.assert_array_equal(smpl[..., :66], pose[..., :66])
        np.testing.assert_array_equal(smpl[..., 66:], np.zeros((2, 5, 6)))
    pose = rng.normal(size=72)
    smpl = smpl_pose_from_smplh(pose)
    np.testing.assert_array_equal(smpl, pose)
    assert smpl is not pose and smpl_pose_from_smplh(np.zeros((0, 156))).shape == (0, 72)
    with pytest.raises(DataError, match=r"\[\.\.\., 156\] \(SMPL-H\).*got \[5, 63\]"):
        smpl_pose_from_smplh(np.zeros((5, 63)))
