"""Renderers of normals: error against time, skeleton maps and skinning, and which targets were met.

    python benchmarks/rendering.py
    python benchmarks/rendering.py --rounds 30 --out build
    python benchmarks/rendering.py --osmesa-packages FOLDER

One frame at a time on one thread, unless said otherwise; OpenGL on a CPU (llvmpipe) takes all cores. Milliseconds a
frame: fastest and median round by the clock, and the least of the processor's time. Errors are angles in degrees
against spheres and capsules whose rays are solved exactly, away from the silhouette by more than 4 px and nearer to it;
`px` is how many pixels only mesh or surface covers. `body` is the bundled one, walking.

`numba` is the project's default, vertex normals included, skinning not, into memory that is used again. `pyrender ...,
tuned` is its second renderer: normals shader, one renderer, vertex buffers rewritten, floats, one sample a pixel.
`default, colours` gives pyrender normals as colours of the vertices; `default, lit` is a scene with one lamp made anew
for each frame from a trimesh, as in pyrender's examples, and shows no normals.

EGL and OSMesa are measured in processes of their own, where they work. OSMesa needs PyOpenGL 3.1.10, which pyrender
0.1.45 does not ask for: pip install --no-deps --target FOLDER PyOpenGL==3.1.10
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np
from rendering_routes import SIZES, Measurement, surface_camera, walk

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.render.normals import render_normal_maps, render_normals
from ctlev_core.render.skeleton import DRAWINGS, draw_skeleton

PLATFORMS = ("egl", "osmesa")
BATCH = 64
STEPS = 10_000_000
FRAME_MS_WANTED, TUNED_WANTED, DEFAULT_WANTED, SCALING_WANTED = 1.2, 5.0, 50.0, 1.7
MEAN_DEG_WANTED, FACES_WANTED, SKELETON_MS_WANTED = 0.05, 20_000, 0.6


def main() -> None:
    """Print the tables, write the plot, then say what was reached."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("build"), help="folder for the plot")
    parser.add_argument("--osmesa-packages", type=Path, help="folder with a PyOpenGL that has OSMesa")
    arguments = parser.parse_args()
    by_platform: dict[str, list[Measurement]] = {}
    for platform in PLATFORMS:
        packages = arguments.osmesa_packages if platform == "osmesa" else None
        by_platform[platform] = measure_routes(platform, arguments.rounds, packages)
        print_routes(platform, by_platform[platform])
    targets = [("frame of normals", *target) for target in route_targets(by_platform)]
    targets += batches(arguments.rounds)
    targets += skeletons(arguments.rounds)
    targets += skinning()
    arguments.out.mkdir(parents=True, exist_ok=True)
    plot(by_platform, arguments.out / "rendering.svg")
    print(f"\nPlot: {arguments.out / 'rendering.svg'}\n\nTargets")
    for topic, what, reached, is_met in targets:
        print(f"  {'met' if is_met else 'MISSED':7} {topic}: {what}: {reached}")


def measure_routes(platform: str, rounds: int, packages: Path | None) -> list[Measurement]:
    """What `rendering_routes.py` measures in a process with that platform of OpenGL, numba beside it."""
    environment = os.environ | {"PYOPENGL_PLATFORM": platform}
    if packages is not None:
        environment["PYTHONPATH"] = os.pathsep.join([str(packages), *filter(None, [os.environ.get("PYTHONPATH")])])
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "measurements.json"
        script = Path(__file__).with_name("rendering_routes.py")
        command = [sys.executable, str(script), "--rounds", str(rounds), "--out", str(out)]
        subprocess.run(command, env=environment, check=True)
        return [Measurement(**row) for row in json.loads(out.read_text())]


def print_routes(platform: str, measurements: list[Measurement]) -> None:
    """One line a renderer, scene and size."""
    if not any("pyrender" in row.route for row in measurements):
        print(f"\n{platform}: no such OpenGL here; numba alone")
    print(f"\n{'in a process with ' + platform:34} scene     px   faces |     ms  median     cpu | error", end="")
    print("      max      rim      max     px")
    for row in measurements:
        line = f"{row.route:34} {row.scene:8} {row.size_px:3} {row.num_faces:7} | "
        line += f"{row.min_ms:6.2f}  {row.median_ms:6.2f}  {row.cpu_ms:6.2f} |"
        if row.error is not None:
            degrees = [row.error[name] for name in ("mean_deg", "max_deg", "rim_mean_deg", "rim_max_deg")]
            line += "".join(f" {value:8.4f}" for value in degrees) + f" {row.error['coverage_px']:6}"
        print(line)


def route_targets(by_platform: dict[str, list[Measurement]]) -> list[tuple[str, str, bool]]:
    """Targets of one frame: time, ratios to pyrender in the same process and rounds, error at 20,000 faces."""
    found = []
    bodies = [row for rows in by_platform.values() for row in rows if row.scene == "body" and row.size_px == SIZES[0]]
    fastest = min(row.min_ms for row in bodies if row.route == "numba")
    wanted = f"at most {FRAME_MS_WANTED} ms at 256 px on one core"
    found.append((wanted, f"{fastest:.2f} ms", fastest <= FRAME_MS_WANTED))
    for platform, rows in by_platform.items():
        times = {row.route: row.min_ms for row in rows if row.scene == "body" and row.size_px == SIZES[0]}
        for setup, ratio in (("tuned", TUNED_WANTED), ("default, lit", DEFAULT_WANTED)):
            peer = times.get(f"pyrender {platform}, {setup}")
            if peer is not None:
                reached = peer / times["numba"]
                found.append((f"{ratio:g} x pyrender {platform}, {setup}", f"{reached:.1f} x", reached >= ratio))
    for row in next(iter(by_platform.values())):
        if row.route == "numba" and row.error is not None and 0.9 < row.num_faces / FACES_WANTED < 1.1:
            mean = row.error["mean_deg"]
            what = f"mean error below {MEAN_DEG_WANTED} degrees, {row.scene} at {row.size_px} px"
            found.append((what, f"{mean:.3f}", mean < MEAN_DEG_WANTED))
    return found


def batches(rounds: int) -> list[tuple[str, str, str, bool]]:
    """From poses to pictures in batches of 64, on one core and on two."""
    body, size, camera = load_body(), SIZES[0], surface_camera(SIZES[0]).repeat(BATCH, axis=0)
    rotations, transl = walk(BATCH)
    vertices, _ = pose_vertices(body, rotations, np.zeros(10), transl)
    scene = vertices, body.faces, camera, (size, size)
    used = render_normals(*scene)
    jobs: dict[str, Callable[[], object]] = {
        "skinning": lambda: pose_vertices(body, rotations, np.zeros(10), transl),
        "normals into new memory": lambda: render_normals(*scene),
        "normals": lambda: render_normals(*scene, out=used),
        "normals, two cores": lambda: render_normals(*scene, workers=2, out=used),
        "pictures of normals": lambda: render_normal_maps(*scene, "controlnet"),
        "pictures of normals, two cores": lambda: render_normal_maps(*scene, "controlnet", workers=2),
        "arithmetic": lambda: in_threads(count_up, 1),
        "arithmetic, two cores": lambda: in_threads(count_up, 2),
    }
    print(f"\nBatches of {BATCH} poses of {len(body.v_template)} vertices at {size} px, ms a frame: min, median, cpu")
    fastest = print_times(jobs, BATCH, rounds)
    print(f"  from pose to picture on one core: {fastest['skinning'] + fastest['pictures of normals']:.2f} ms")
    machine = fastest["arithmetic"] / fastest["arithmetic, two cores"]
    found = []
    for name in ("normals", "pictures of normals"):
        ratio = fastest[name] / fastest[f"{name}, two cores"]
        reached = f"{ratio:.2f} x, where arithmetic alone gets {machine:.2f} x"
        found.append(
            (f"batch of {name}", f"two cores at least {SCALING_WANTED} x one", reached, ratio >= SCALING_WANTED)
        )
    return found


def in_threads(work: Callable[[int], object], workers: int) -> None:
    """Divide a fixed amount of work that touches no memory: what two cores are worth on this machine, now."""
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, [STEPS // workers] * workers))


@numba.njit(nogil=True)
def count_up(steps: int) -> int:
    """Some arithmetic that no compiler shortens."""
    state = np.uint64(1)
    for _ in range(steps):
        state ^= state << np.uint64(13)
        state ^= state >> np.uint64(7)
        state ^= state << np.uint64(17)
    return int(state)


def skeletons(rounds: int) -> list[tuple[str, str, str, bool]]:
    """Skeleton maps of a walk at 256 px, each way of drawing them."""
    body, size, (fx, fy, cx, cy) = load_body(), SIZES[0], surface_camera(SIZES[0])[0]
    rotations, transl = walk(BATCH)
    _, joints = pose_vertices(body, rotations, np.zeros(10), transl)
    joints2d = joints[..., :2] / joints[..., 2:] * [fx, fy] + [cx, cy]
    visible = np.ones(joints2d.shape[1], bool)

    def draw(drawing: str) -> None:
        for frame in joints2d:
            draw_skeleton(frame, visible, "smpl", (size, size), drawing)

    print(f"\nSkeleton maps at {size} px, ms a frame: min, median, cpu")
    fastest = print_times({name: (lambda name=name: draw(name)) for name in DRAWINGS}, BATCH, rounds)
    wanted = f"below {SKELETON_MS_WANTED} ms at 256 px"
    return [(f"skeleton map '{name}'", wanted, f"{ms:.2f} ms", ms < SKELETON_MS_WANTED) for name, ms in fastest.items()]


def skinning() -> list[tuple[str, str, str, bool]]:
    """What `skinning.py` measures beside this file: milliseconds for 64 poses, and errors against float64."""
    if importlib.util.find_spec("skinning") is None:
        return []
    rows = importlib.import_module("skinning").measure_skinning()
    print(f"\nSkinning: {'route':46} ms   error in mm")
    for row in rows:
        print(f"  {row['route']:54} {row['ms']:6.2f} {row['error_mm']:10.6f}")
    # Rows without correctives do less than smplx does.
    peers = [row["ms"] for row in rows if row["route"] == "smplx"]
    ours = [row["ms"] for row in rows if row["route"] in ("numba", "torch")]
    if not peers:
        print("  smplx is not installed: nothing to compare with")
        return []
    reached = f"{min(ours):.1f} ms against {min(peers):.1f} ms"
    return [("skinning", "a batch of 64 faster than smplx", reached, min(ours) < min(peers))]


def print_times(jobs: dict[str, Callable[[], object]], count: int, rounds: int) -> dict[str, float]:
    """Time jobs in turns, after one round that is not timed; returns the fastest milliseconds per item."""
    wall: dict[str, list[float]] = {name: [] for name in jobs}
    cpu: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(rounds + 1):
        for name, run in jobs.items():
            cpu_start, start = time.process_time(), time.perf_counter()
            run()
            if turn:
                wall[name].append(1e3 * (time.perf_counter() - start) / count)
                cpu[name].append(1e3 * (time.process_time() - cpu_start) / count)
    for name in jobs:
        print(f"  {name:34} {min(wall[name]):6.3f} {statistics.median(wall[name]):6.3f}", end="")
        print(f" {min(cpu[name]):6.3f}")
    return {name: min(times) for name, times in wall.items()}


def plot(by_platform: dict[str, list[Measurement]], path: Path) -> None:
    """Mean error away from the silhouette, and at it, over milliseconds a frame; lines join meshes of more faces."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(2, len(SIZES), figsize=(11, 8), sharex=True, sharey="row", constrained_layout=True)
    rows = [row for found in by_platform.values() for row in found if row.error is not None and row.scene == "sphere"]
    routes = dict.fromkeys(row.route for row in rows)
    for panel_row, field, label in zip(
        panels, ("mean_deg", "rim_mean_deg"), ("away from the silhouette", "within 4 px of it"), strict=True
    ):
        for panel, size in zip(panel_row, SIZES, strict=True):
            for route in routes:
                points = sorted(
                    (row.num_faces, row.min_ms, row.error[field])
                    for row in rows
                    if row.route == route and row.size_px == size and row.error is not None
                )
                # numba is measured in each process: the faster one counts.
                best = {faces: (ms, error) for faces, ms, error in sorted(points, reverse=True)}
                panel.loglog(*zip(*best.values(), strict=True), "o-", label=route)
            panel.set_title(f"{size} x {size} px, sphere of {min(best):,} to {max(best):,} faces")
            panel.grid(True, which="both", alpha=0.3)
        panel_row[0].set_ylabel(f"mean error in degrees,\n{label}")
    for panel in panels[-1]:
        panel.set_xlabel("milliseconds a frame")
    panels[0, 0].legend(fontsize=8)
    figure.savefig(path)
    plt.close(figure)


if __name__ == "__main__":
    main()
