"""How fast a batch of poses becomes vertices, and how far off in mm, beside smplx.

    python benchmarks/skinning.py
    python benchmarks/skinning.py --frames 256 --rounds 30

One thread; from axis-angle poses to vertices, milliseconds of CPU time a batch, the median of interleaved rounds, and
the largest error against float64. The body has SMPL's shapes and four random bones a vertex, which is more than most
vertices of the real one have. `correctives` are the pose-dependent shapes, one product of [frames, 207] by
[207, 20670], which smplx always applies: its time is compared with both. `limit` is that product alone. smplx
(`pip install smplx`) is left out where it is not installed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import pickle
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from ctlev_core.body.layer import BodyModel, make_body, pose_vertices
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.body.torch_layer import BodyLayer
from ctlev_core.geometry.joint_sets import SMPL_PARENTS

NUM_VERTICES, NUM_FACES = 6890, 13776


@dataclass(frozen=True)
class Route:
    """A way to pose vertices: its name, what makes them [T, V, 3] m, and what they should be."""

    name: str
    run: Callable[[], np.ndarray]
    expected: np.ndarray


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=64, help="poses in a batch")
    parser.add_argument("--rounds", type=int, default=15)
    arguments = parser.parse_args()
    rows = measure_skinning(arguments.frames, arguments.rounds)
    smplx_ms = next((row["ms"] for row in rows if row["route"] == "smplx"), None)
    print(f"{arguments.frames} poses of {NUM_VERTICES} vertices, one thread")
    print(f"{'route':32}{'ms':>9}{'ms a pose':>11}{'error mm':>11}" + ("  smplx / route" if smplx_ms else ""))
    for row in rows:
        ratio = f"{smplx_ms / row['ms']:15.1f}" if smplx_ms else ""
        print(f"{row['route']:32}{row['ms']:9.2f}{row['ms'] / arguments.frames:11.3f}{row['error_mm']:11.5f}{ratio}")


def measure_skinning(frames: int = 64, rounds: int = 15, seed: int = 0) -> list[dict[str, Any]]:
    """CPU milliseconds of a batch of `frames` poses on one thread, and the largest error, of each route.

    Returns:
        Rows {"route": name, "ms": median, "error_mm": maximum}; without smplx, and a line printed, where it is absent.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as folder, torch.no_grad(), threadpool_limits(1):
            routes = make_routes(frames, seed, Path(folder))
            errors = [float(np.abs(route.run() - route.expected).max()) * 1000 for route in routes]
            times_ms: list[list[float]] = [[] for _ in routes]
            for _ in range(rounds):
                for route, measured in zip(routes, times_ms, strict=True):
                    start = time.process_time()
                    route.run()
                    measured.append((time.process_time() - start) * 1000)
    finally:
        torch.set_num_threads(threads)
    return [
        {"route": route.name, "ms": statistics.median(measured), "error_mm": error}
        for route, measured, error in zip(routes, times_ms, errors, strict=True)
    ]


def make_routes(frames: int, seed: int, folder: Path) -> list[Route]:
    """Every route that can run here, on the same poses."""
    rng = np.random.default_rng(seed)
    arrays = random_smpl_arrays(rng)
    pose = rng.normal(0, 0.5, (frames, 72)).astype(np.float32)
    betas, transl = rng.normal(size=10).astype(np.float32), rng.normal(size=(frames, 3)).astype(np.float32)
    tensors = tuple(torch.from_numpy(array) for array in (pose, betas, transl))
    routes = []
    for correctives in (True, False):
        body = make_body(
            *(arrays[name] for name in ("v_template", "f", "weights", "shapedirs", "J_regressor")),
            posedirs=arrays["posedirs"] if correctives else None,
        )
        name = "" if correctives else ", no correctives"
        exact = BodyLayer(body, torch.float64)(*(tensor.double() for tensor in tensors))[0].numpy()
        layer, out = BodyLayer(body), np.empty(exact.shape, np.float32)
        routes += [
            Route(f"numba{name}", _numba(body, pose, betas, transl, None), exact),
            Route(f"numba, reused memory{name}", _numba(body, pose, betas, transl, out), exact),
            Route(f"torch{name}", lambda layer=layer: layer(*tensors)[0].numpy(), exact),
        ]
        if body.posedirs is not None:
            features = rng.normal(size=(frames, 207)).astype(np.float32)
            product = np.matmul(features, body.posedirs, out=out.reshape(frames, -1)).copy()
            limit = Route("limit", partial(np.matmul, features, body.posedirs), product)
            routes += [*_smplx(arrays, tensors, exact, folder), limit]
    return routes


def random_smpl_arrays(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A body file's arrays in SMPL's layout, of random numbers that float32 holds exactly."""
    weights = np.zeros((NUM_VERTICES, 24))
    bones = np.argsort(rng.random((NUM_VERTICES, 24)), axis=1)[:, :4]
    np.put_along_axis(weights, bones, rng.dirichlet(np.ones(4), NUM_VERTICES), axis=1)
    regressor = np.zeros((24, NUM_VERTICES))
    for joint in regressor:
        joint[rng.choice(NUM_VERTICES, 30, replace=False)] = rng.dirichlet(np.ones(30))
    arrays = {
        "v_template": rng.uniform(-0.9, 0.9, (NUM_VERTICES, 3)),
        "weights": weights,
        "shapedirs": 0.02 * rng.normal(size=(NUM_VERTICES, 3, 10)),
        "posedirs": 0.003 * rng.normal(size=(NUM_VERTICES, 3, 207)),
        "J_regressor": regressor,
    }
    tables = {
        "f": rng.integers(0, NUM_VERTICES, (NUM_FACES, 3)).astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, *SMPL_PARENTS[1:]], range(24)], np.uint32),
    }
    return {name: array.astype(np.float32).astype(np.float64) for name, array in arrays.items()} | tables


def _numba(
    body: BodyModel, pose: np.ndarray, betas: np.ndarray, transl: np.ndarray, out: np.ndarray | None
) -> Callable[[], np.ndarray]:
    return lambda: pose_vertices(body, matrix_from_axis_angle(pose.reshape(-1, 24, 3)), betas, transl, out)[0]


def _smplx(
    arrays: dict[str, np.ndarray], tensors: tuple[torch.Tensor, ...], exact: np.ndarray, folder: Path
) -> list[Route]:
    if not importlib.util.find_spec("smplx"):
        print("smplx is not installed and left out: pip install smplx")
        return []
    import smplx  # pyright: ignore[reportMissingImports]

    (folder / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(arrays, 2))
    pose, betas, transl = tensors
    # It prints that the file has ten shape coefficients only.
    with contextlib.redirect_stdout(io.StringIO()):
        model = smplx.SMPL(str(folder / "SMPL_NEUTRAL.pkl"), batch_size=len(pose))
    each = betas.expand(len(pose), 10).contiguous()

    def run() -> np.ndarray:
        return model(betas=each, global_orient=pose[:, :3], body_pose=pose[:, 3:], transl=transl).vertices.numpy()

    return [Route("smplx", run, exact)]


if __name__ == "__main__":
    main()
