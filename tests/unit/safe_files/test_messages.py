"""Files broken at random, of every kind that is read: a refusal names the file in less than 500 characters."""

import pickle
import random

import fuzz_reader
import motion_writers
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from ctlev_core import plugins
from ctlev_core.events.decoding import record_files
from ctlev_core.safe_files import safe_pickle, tensor_files
from ctlev_core.sensor import options
from data_contracts.errors import DataError

COUNT = {"aedat4": 10, "hdf5": 100}
"""Files of a kind; the others are read in a fraction of a millisecond."""
RANDOM = np.random.default_rng(0)


def write_amass(path):
    arrays = {"poses": RANDOM.normal(size=(4, 156)), "trans": np.zeros((4, 3)), "betas": np.zeros(16)}
    with path.open("wb") as file:
        np.savez(file, mocap_framerate=60.0, **arrays)


def save(path, array):
    with path.open("wb") as file:
        np.save(file, array, allow_pickle=True)


OTHERS = {
    "amass": (plugins.load("motions", "amass").read, write_amass),
    "SMPL poses": (plugins.load("motions", "smpl_arrays").read, lambda path: save(path, RANDOM.normal(size=(4, 72)))),
    "MDM": (
        plugins.load("motions", "smpl_arrays").read,
        lambda path: save(path, {"thetas": RANDOM.normal(size=(1, 25, 6, 4)), "text": ["x"]}),
    ),
    "joints": (plugins.load("motions", "joints_npy").read, lambda path: save(path, RANDOM.normal(size=(4, 22, 3)))),
    "bvh": (
        plugins.load("motions", "bvh").read,
        lambda path: motion_writers.write_bvh(path, np.zeros((3, len(motion_writers.T_POSE), 3)), np.zeros((3, 3))),
    ),
    "deepmimic": (
        plugins.load("motions", "deepmimic").read,
        lambda path: motion_writers.write_deepmimic(path, motion_writers.standing_frames(3)),
    ),
    "torch": (tensor_files.read_tensor_table, lambda path: torch.save({"a": torch.zeros(3)}, path)),
    "safetensors": (tensor_files.read_tensor_table, lambda path: save_file({"a": torch.zeros(3)}, path)),
    "pickle": (safe_pickle.load, lambda path: path.write_bytes(pickle.dumps({"a": [1, {"b": np.zeros(3)}]}, 2))),
    "sensor": (options.read_preset, lambda path: path.write_text("threshold_on: 0.2\nrefractory_us: [1, 2]\n")),
}


def broken(seeds, count):
    chance = random.Random(0)
    return [fuzz_reader.mutate(chance.choice(seeds), chance) for _ in range(count)]


@pytest.mark.parametrize("name", plugins.names("formats"))
def test_event_files(name, tmp_path, monkeypatch):
    monkeypatch.setattr(record_files, "_SMALLEST_BLOCK", 3)  # as it is set there; afterwards as it was
    module = plugins.load("formats", name)
    path = tmp_path / "broken"
    for content in broken(list(fuzz_reader.valid_files(name, tmp_path)), COUNT.get(name, 300)):
        path.write_bytes(content)
        fuzz_reader.check_reader(module, path)


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.filterwarnings("ignore")
def test_other_files(kind, tmp_path):
    read, write = OTHERS[kind]
    write(tmp_path / "whole")
    path, refused = tmp_path / "broken", 0
    for content in broken([(tmp_path / "whole").read_bytes()], 300):
        path.write_bytes(content)
        try:
            read(path)
        except DataError as error:
            fuzz_reader.check_message(error, path)
            refused += 1
    assert refused > 30
