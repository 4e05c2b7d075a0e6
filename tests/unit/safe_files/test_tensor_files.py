"""Weights files are read as safetensors and torch wrote them; code, lies and damage are refused."""

import json
import os
import pickle
import tracemalloc
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from ctlev_core.diffusion.pretrained.model_building import load_tensor
from ctlev_core.safe_files.tensor_files import check_finite, read_tensor_table
from ctlev_core.safe_files.torch_files import read_torch_table
from data_contracts.errors import DataError

DTYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}


def tensors_of_every_type():
    random = torch.Generator().manual_seed(0)
    return {
        **{name: (torch.rand(3, 2, generator=random) * 100).to(dtype) for name, dtype in DTYPES.items()},
        "scalar": torch.tensor(2.5),
        "empty": torch.zeros(0, 4),
        "odd": torch.arange(7, dtype=torch.uint8),
    }


def write(path, tensors):
    """By the file's ending."""
    if path.suffix == ".safetensors":
        save_file(tensors, path, metadata={"format": "pt"})
    else:
        torch.save(tensors, path)
    return path


def check_loads(path, expected):
    table = read_tensor_table(path)
    assert table.keys() == expected.keys()
    for name, value in expected.items():
        assert table[name].shape == tuple(value.shape)
        loaded = load_tensor(table[name], value.dtype)
        assert loaded.dtype == value.dtype and torch.equal(loaded, value), name
    check_finite(table.items())


@pytest.mark.parametrize("ending", [".safetensors", ".pth"])
def test_every_type_is_read_as_it_was_written(tmp_path, ending):
    expected = tensors_of_every_type()
    check_loads(write(tmp_path / f"file{ending}", expected), expected)
    (tmp_path / f"file{ending}").rename(tmp_path / "file.weights")  # the content counts, not the name
    check_loads(tmp_path / "file.weights", expected)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_views_parameters_and_attributes_of_state_dicts_are_read(tmp_path, protocol):
    base = torch.arange(60, dtype=torch.float32).reshape(3, 4, 5)
    expected = {
        "base": base,
        "row": base[1],
        "column": base[:, 2],
        "turned": base.permute(2, 0, 1),
        "repeated": base[0, :1].expand(6, 5),
        "parameter": torch.nn.Parameter(base[2]),
    }
    torch.save({"state_dict": expected, "epoch": 3, "score": np.float64(2)}, tmp_path / "a", pickle_protocol=protocol)
    check_loads(tmp_path / "a", expected)
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))
    torch.save(network.state_dict(), tmp_path / "b", pickle_protocol=protocol)
    check_loads(tmp_path / "b", network.state_dict())


class Attack:
    """Writes a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


@pytest.mark.parametrize("ending", [".safetensors", ".bin", ".ckpt", ".pth"])
def test_nothing_in_a_pickle_runs(tmp_path, ending):
    proof, path = tmp_path / "it_ran", tmp_path / f"weights{ending}"
    tensors = {"weight": torch.zeros(2)}
    attacks = {
        **{f"pickle {protocol}": pickle.dumps(Attack(proof), protocol) for protocol in range(6)},
        **{f"dictionary {protocol}": pickle.dumps({"a": Attack(proof)}, protocol) for protocol in range(6)},
    }
    for name, content in attacks.items():
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"bare pickle|no safetensors file|truncated"):
            read_tensor_table(path)
        assert not proof.exists(), name
    for legacy in (False, True):
        torch.save({**tensors, "attack": Attack(proof)}, path, _use_new_zipfile_serialization=not legacy)
        with pytest.raises(DataError, match="bare pickle" if legacy else r"refused: it names posix\.system"):
            read_tensor_table(path)
        assert not proof.exists()
    torch.save(tensors, path, _use_new_zipfile_serialization=False)  # harmless, but only a pickle could tell
    with pytest.raises(
        DataError, match=r"expected safetensors, or the archive that torch\.save writes since torch 1\.6"
    ):
        read_tensor_table(path)


def test_attack_in_the_test_would_run(tmp_path):
    pickle.loads(pickle.dumps(Attack(tmp_path / "it_ran")))
    assert (tmp_path / "it_ran").exists()


@pytest.mark.parametrize("ending", [".safetensors", ".pth"])
def test_a_cut_file_is_refused_wherever_it_is_cut(tmp_path, ending):
    content = write(tmp_path / f"whole{ending}", tensors_of_every_type()).read_bytes()
    path = tmp_path / "cut"
    for size in [*range(0, 64, 7), *range(64, len(content), 61), len(content) - 1]:
        path.write_bytes(content[:size])
        with pytest.raises(DataError, match=str(path)):
            read_tensor_table(path)


def test_truncated_safetensors_say_how_many_bytes_were_expected(tmp_path):
    path = write(tmp_path / "x.safetensors", {"a": torch.zeros(100)})
    size = path.stat().st_size
    content = path.read_bytes()
    for changed, message in (
        (content[:-40], f"truncated: expected {size} bytes, got {size - 40}"),
        (content + b"more", f"longer than its header says: expected {size} bytes, got {size + 4}"),
        (b"\x00" * 4, "no safetensors file: 4 bytes"),
        (b"", "no safetensors file: 0 bytes"),
        (b"<!DOCTYPE html><html>", "no safetensors file"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 4\n", "pointer of Git LFS"),
    ):
        path.write_bytes(changed)
        with pytest.raises(DataError, match=message):
            read_tensor_table(path)
    with pytest.raises(DataError, match="got a folder"):
        read_tensor_table(tmp_path)


def with_header(header, data=b""):
    text = json.dumps(header).encode() if not isinstance(header, bytes) else header
    return len(text).to_bytes(8, "little") + text + data


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            {"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 4]}},
            "'a' of shape .2. F32 cannot lie in bytes 0 to 4",
        ),
        ({"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}, "header cannot be read"),
        ({"a": {"dtype": "F32", "shape": [1], "data_offsets": [8, 4]}}, "cannot lie in bytes 8 to 4"),
        ({"a": {"dtype": "F32", "shape": [1.0], "data_offsets": [0, 4]}}, "header cannot be read"),
        ({"a": {"dtype": "F8_E4M3", "shape": [4], "data_offsets": [0, 4]}}, "of type F8_E4M3; read are F64, F32"),
        ({"a": {"dtype": "F32", "shape": [1]}}, "header cannot be read"),
        ({"a": 3}, "header cannot be read"),
        ([1], "header cannot be read"),
        (b"{" * 5000, "header cannot be read"),
        (b"\xff{}", "header cannot be read"),
    ],
)
def test_headers_that_lie_are_refused(tmp_path, header, message):
    (tmp_path / "x").write_bytes(with_header(header, b"\x00" * 4))
    with pytest.raises(DataError, match=message):
        read_tensor_table(tmp_path / "x")


@pytest.mark.parametrize("dtype", ["F64", "F32", "F16", "BF16"])
def test_data_may_begin_at_any_byte(tmp_path, dtype):
    """Of safetensors only the order is prescribed; writers pad the header, but need not."""
    values = torch.tensor([1.5, -2.0, 3.0], dtype=DTYPES[dtype])
    data = values.view(torch.uint8).numpy().tobytes()
    for padding in range(8):
        entry = {"dtype": dtype, "shape": [3], "data_offsets": [0, len(data)]}
        header = json.dumps({"a": entry}) + " " * padding
        (tmp_path / "x").write_bytes(with_header(header.encode(), data))
        check_loads(tmp_path / "x", {"a": values})


def rewritten(path, tensors, change):
    """A torch archive whose entries go through `change`: name and content to content, None drops it."""
    torch.save(tensors, path.with_suffix(".whole"))
    with zipfile.ZipFile(path.with_suffix(".whole")) as source, zipfile.ZipFile(path, "w") as target:
        for entry in source.infolist():
            content = change(entry.filename.split("/", 1)[1], source.read(entry))
            if content is not None:
                target.writestr(entry.filename, content)
    return path


def test_archives_that_lie_are_refused(tmp_path):
    tensors = {"a": torch.arange(4, dtype=torch.float32), "b": torch.ones(3)}
    path = tmp_path / "x.pth"
    read_tensor_table(rewritten(path, tensors, lambda _, content: content))
    cases = [
        (lambda name, content: content[:-4] if name == "data/0" else content, "data/0 of 4 items F32 has 12 bytes"),
        (lambda name, content: None if name == "data/1" else content, "data/1 is missing"),
        (lambda name, content: None if name == "data.pkl" else content, "holds 0 files data.pkl"),
        (lambda name, content: b"big" if name == "byteorder" else content, "little-endian"),
        (
            lambda name, content: content[:-9] if name == "data.pkl" else content,
            "it claims 1 more bytes where at most 0",
        ),
        # The shape (4,) becomes (9,): more than is stored.
        (lambda name, content: content.replace(b"K\x04\x85", b"K\x09\x85", 1), "reaches beyond its storage of 4 items"),
    ]
    for change, message in cases:
        with pytest.raises(DataError, match=message):
            read_tensor_table(rewritten(path, tensors, change))
    torch.save([torch.zeros(2)], path)
    with pytest.raises(DataError, match="holds no named tensors"):
        read_tensor_table(path)
    with zipfile.ZipFile(tmp_path / "packed.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        torch.save(tensors, tmp_path / "whole")
        with zipfile.ZipFile(tmp_path / "whole") as source:
            for entry in source.infolist():
                archive.writestr(entry.filename, source.read(entry))
    with pytest.raises(DataError, match="is compressed"):
        read_tensor_table(tmp_path / "packed.zip")


@settings(max_examples=150, deadline=None)
@given(position=st.integers(0, 10**6), value=st.integers(0, 255), archive=st.booleans())
def test_a_wrong_byte_is_refused_or_changes_values_alone(tmp_path_factory, position, value, archive):
    folder = tmp_path_factory.mktemp("byte")
    path = write(folder / ("x.pth" if archive else "x.safetensors"), OrderedDict(a=torch.ones(3, 5), b=torch.zeros(2)))
    content = bytearray(path.read_bytes())
    content[position % len(content)] = value
    path.write_bytes(content)
    try:
        table = read_tensor_table(path)
    except DataError:
        return
    for tensor in table.values():  # inside the file, whatever the byte was
        assert load_tensor(tensor, torch.float32).shape == tensor.shape


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_values_that_are_not_finite_are_named(tmp_path, dtype, value):
    largest = torch.full((5,), torch.finfo(dtype).max, dtype=dtype)
    good = {"first": largest, "second": -largest, "third": torch.full((3,), torch.finfo(dtype).tiny, dtype=dtype)}
    path = write(tmp_path / "x.safetensors", good)
    check_finite(read_tensor_table(path).items())
    good["second"][4] = value
    write(path, good)
    with pytest.raises(DataError, match=r"x\.safetensors: tensor 'second' holds values that are not finite"):
        check_finite(read_tensor_table(path).items())


def repacked(tmp_path, **replaced):
    """A file of torch whose members of some names are others, compressed."""
    torch.save({"a": torch.zeros(2)}, tmp_path / "whole.pt")
    with zipfile.ZipFile(tmp_path / "whole.pt") as whole, zipfile.ZipFile(tmp_path / "bomb.pt", "w") as bomb:
        for name in whole.namelist():
            content = replaced.get(name.rpartition("/")[2].partition(".")[0])
            packing = zipfile.ZIP_STORED if content is None else zipfile.ZIP_DEFLATED
            bomb.writestr(name, whole.read(name) if content is None else content, packing)
    return tmp_path / "bomb.pt"


@pytest.mark.parametrize("member", ["byteorder", "data"])
def test_members_that_unpack_without_bound_are_refused_before(tmp_path, member):
    path = repacked(tmp_path, **{member: bytes(200 * 2**20)})
    assert path.stat().st_size < 2**20
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"bomb\.pt: .*is compressed; torch does not do that"):
            read_torch_table(path)
        assert tracemalloc.get_traced_memory()[1] < 20 * 2**20
    finally:
        tracemalloc.stop()


def test_a_pickle_is_no_larger_than_names_and_shapes_need(tmp_path, monkeypatch):
    torch.save({"a": torch.zeros(2)}, tmp_path / "a.pt")
    monkeypatch.setattr("ctlev_core.safe_files.torch_files.MAX_PICKLE", 50)
    with pytest.raises(DataError, match=r"data\.pkl has \d+ bytes, at most 50 are read"):
        read_torch_table(tmp_path / "a.pt")
