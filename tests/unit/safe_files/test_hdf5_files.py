"""HDF5 files that lead out of themselves, or hold more than their size says."""

import subprocess
import sys
import textwrap
import zlib

import h5py
import numpy as np
import pytest

from ctlev_core.dataset_files.dhp19_files import read_frame_labels
from ctlev_core.formats import hdf5
from ctlev_core.networks.dhp19_weights import read_keras_weights
from ctlev_core.safe_files import hdf5_files
from data_contracts.errors import DataError

COUNT = 50
COLUMNS = {"t": np.arange(COUNT), "x": np.arange(COUNT) % 7, "y": np.arange(COUNT) % 5, "p": np.arange(COUNT) % 2}


def write(path, x=None):
    """Events whose column x is made by a function of the group."""
    with h5py.File(path, "w") as file:
        group = file.create_group("events")
        group.attrs["sensor_size"] = (640, 480)
        for name, values in COLUMNS.items():
            if name == "x" and x is not None:
                x(group)
            else:
                group[name] = values.astype("u2")
    return path


def external_storage(place):
    return lambda group: group.create_dataset("x", (COUNT,), "u1", external=[(str(place), 0, COUNT)])


def virtual(place):
    layout = h5py.VirtualLayout((COUNT,), "u2")
    layout[:] = h5py.VirtualSource(str(place), "x", (COUNT,))
    return lambda group: group.create_virtual_dataset("x", layout)


def linked(place):
    return lambda group: group.__setitem__("x", h5py.ExternalLink(str(place), "x"))


def linked_twice(place):
    def put(group):
        group.file["hidden"] = h5py.ExternalLink(str(place), "/")
        group["x"] = h5py.SoftLink("/hidden/x")

    return put


LEADING_OUT = {
    "external storage": (external_storage, "its values are in another file"),
    "virtual": (virtual, "put together from datasets of other files"),
    "external link": (linked, "is a link to another file"),
    "soft link to an external one": (linked_twice, "is a link to another file"),
}


@pytest.mark.parametrize("kind", LEADING_OUT)
def test_what_leads_out_of_the_file_is_refused(tmp_path, kind):
    make, message = LEADING_OUT[kind]
    secret = tmp_path / "secret"
    if make is external_storage:
        secret.write_bytes(b"secret of this machine" * 10)
    else:
        with h5py.File(secret, "w") as file:
            file["x"] = COLUMNS["x"].astype("u2")
    path = write(tmp_path / "a.h5", make(secret))
    for read in (hdf5.read, lambda path: list(hdf5.read_chunks(path, 3))):
        with pytest.raises(DataError, match=rf"a\.h5: .*{message}") as refused:
            read(path)
        assert len(str(refused.value)) < 500


def test_links_within_the_file_are_followed_but_not_in_circles(tmp_path):
    def within(group):
        group.file["elsewhere/x"] = COLUMNS["x"].astype("u2")
        group["x"] = h5py.SoftLink("/elsewhere/x")

    assert np.array_equal(hdf5.read(write(tmp_path / "a.h5", within)).x, COLUMNS["x"])

    def circle(group):
        group["x"], group["z"] = h5py.SoftLink("/events/z"), h5py.SoftLink("/events/x")

    with pytest.raises(DataError, match="is a link to a link, and so on"):
        hdf5.read(write(tmp_path / "b.h5", circle))


def large_chunk(group):
    """320 MB of zeros in 300 kB, never in memory here."""
    x = group.create_dataset("x", (COUNT,), "u8", maxshape=(None,), chunks=(40_000_000,), compression="gzip")
    packer = zlib.compressobj()
    x.id.write_direct_chunk((0,), b"".join([packer.compress(bytes(10**6)) for _ in range(320)] + [packer.flush()]))


BOUNDED = """
    import sys
    from pathlib import Path
    from ctlev_core.formats import hdf5
    from data_contracts.errors import DataError
    try:
        hdf5.read(Path(sys.argv[1]))
    except DataError as error:
        print("DataError:", error)
    peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    print(int(peak.split()[1]) // 1024)
"""


def test_a_chunk_of_many_values_is_refused_before_it_is_decompressed(tmp_path):
    path = write(tmp_path / "a.h5", large_chunk)
    assert path.stat().st_size < 1 << 20
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(BOUNDED), str(path)], capture_output=True, text=True, timeout=120
    )
    said, peak_mib = done.stdout.splitlines()
    assert "chunks of (40000000,) values are 320000000 bytes" in said and int(peak_mib) < 250


def test_a_large_chunk_is_decompressed_once(tmp_path):
    """Chunks beyond the default cache, read in blocks: time grows with their number, not with its square."""

    def chunked(group):
        group.create_dataset("x", data=np.arange(COUNT, dtype="u8") % 7, maxshape=(None,), chunks=(4_000_000,))

    path = write(tmp_path / "a.h5", chunked)
    with h5py.File(path) as file:
        dataset = hdf5_files.check_dataset(hdf5_files.find_object(file, "events/x", "a"), "x")
        assert dataset.id.get_access_plist().get_chunk_cache()[1] >= 32_000_000
        assert np.array_equal(dataset[:], np.arange(COUNT) % 7)
    assert np.array_equal(hdf5.read(path).x, COLUMNS["x"])


def test_labels_and_weights_are_bounded_too(tmp_path):
    path = tmp_path / "label.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("XYZ", (1 << 40,), "f8", chunks=(1000,))
    with pytest.raises(DataError, match=r"label\.h5: /XYZ"):
        read_frame_labels(path)
    path = tmp_path / "weights.h5"
    with h5py.File(path, "w") as file:
        made = file.create_dataset("model_weights/a/kernel:0", (3, 3, 1 << 10, 1 << 14), "f4", chunks=(3, 3, 64, 64))
        made[:, :, 0, 0] = 1
    with pytest.raises(DataError, match=r"weights\.h5: a/kernel:0: .* at most 268435456 are read"):
        read_keras_weights(path)
    with h5py.File(path, "w") as file:
        file["model_weights"] = h5py.ExternalLink(str(tmp_path / "label.h5"), "/")
    with pytest.raises(DataError, match=r"weights\.h5: model_weights is a link to another file"):
        read_keras_weights(path)
