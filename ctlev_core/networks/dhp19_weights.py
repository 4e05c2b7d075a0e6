"""DHP19's published weights: the Keras file of the authors, as HDF5. Imports nothing heavy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctlev_core.safe_files.hdf5_files import check_dataset, find_object
from data_contracts.errors import DataError

MAX_KERNEL_BYTES = 256 * 2**20
"""Of one layer; the authors' largest has 295 kB."""


def read_keras_weights(path: Path) -> dict[str, np.ndarray]:
    """Kernels float32 by layer, as PyTorch has them: [out, in, 3, 3], and [in, out, 3, 3] of transposed convolutions.

    Args:
        path: `DHP_CNN.model` of the dataset's authors, by whatever name.
    Raises:
        DataError: the file cannot be read, or holds something else than 3 x 3 kernels.
    """
    import h5py

    kernels: dict[str, np.ndarray] = {}

    def keep(name: str, item: object) -> None:
        if name.endswith("/kernel:0") and isinstance(item, h5py.Dataset):
            kernels[name.split("/")[-2]] = np.asarray(check_dataset(item, f"{path}: {name}", MAX_KERNEL_BYTES)[()])

    try:
        with h5py.File(path) as file:
            weights = find_object(file, "model_weights" if "model_weights" in file else "/", str(path))
            if isinstance(weights, h5py.Group):
                weights.visititems(keep)
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path}: cannot be read as weights of a Keras model: {error}") from error
    for name, kernel in kernels.items():
        if kernel.ndim != 4 or kernel.shape[:2] != (3, 3) or not np.isfinite(kernel).all():
            raise DataError(f"{path}: kernel of {name} must be [3, 3, in, out] and finite, got {kernel.shape}")
    if not kernels:
        raise DataError(f"{path}: holds no kernels of a Keras model")
    # Keras keeps (out, in) of transposed convolutions last, of others (in, out); PyTorch each the other way round.
    return {name: np.ascontiguousarray(kernel.transpose(3, 2, 0, 1), np.float32) for name, kernel in kernels.items()}
