"""Twelve artefacts, each of which notes in a file that it was made: python counted_pipeline.py NOTES ORDER_SEED."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa

from data_contracts import tables
from tasks.stage import stage
from tasks.store import Store


@stage(version=1, schema=tables.TRAINING)
def note(out, *, number: int, notes: str) -> pa.Table:
    """Says so when it is made, and takes its time, so that others come meanwhile."""
    with Path(notes).open("ab", buffering=0) as file:
        file.write(f"{number}\n".encode())  # one write of few bytes to a file opened for appending is never torn
    time.sleep(0.05)
    out.write_array("frames", np.full((1, 4), number))
    return pa.table({"curve": ["training"], "step": pa.array([number], pa.int64()), "loss": [0.5]})


if __name__ == "__main__":
    for number in np.random.default_rng(int(sys.argv[2])).permutation(12).tolist():
        arguments = {"number": number, "notes": sys.argv[1]}
        reference, _ = note.run(note.key(arguments, Store()), arguments)
        print(number, reference.digest, os.readlink("/proc/self/ns/pid"))
