"""So many short recordings through the store: files, bytes, time a recording and memory of each step.

    python benchmarks/many_recordings.py 10000
    python benchmarks/many_recordings.py 1500000 --folder /scratch     # 20 to 60 GB of room, not needed afterwards
    python benchmarks/many_recordings.py 100000 --no-kill

Recordings lie in N-ImageNet's layout, a `.npz` file each, of `--events` simulated events in 50 ms (the published ones
have 100,000 on average). `--contents` of them differ; the others are links to these, so that a million take no room.
Each step is a process of its own:

    plan     list the recordings, hash the raw files, calculate the key of `ingest`
    killed   `ingest`, killed when half of the recordings are read
    ingest   goes on from there
    encode   a histogram of 64 x 64 px, two polarities, and an image of each recording
    verify   hash every file of both artefacts again, as `ctlev verify` does
    random   read 1,000 recordings, drawn from all
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ctlev_core.processes import begin_memory_peak, memory_peak_mib  # noqa: E402
from ctlev_core.recordings.stored_events import stored_events  # noqa: E402
from data_contracts.config import DatasetChoice, EncodingChoice, Windows  # noqa: E402
from data_contracts.manifest import ManifestRef, read_manifest  # noqa: E402
from tasks.encode import encode  # noqa: E402
from tasks.ingest import ingest  # noqa: E402
from tasks.stage import Stage  # noqa: E402
from tasks.store import Store  # noqa: E402

SENSOR_SIZE = (640, 480)
PER_CLASS = 1_500
RANDOM_READS = 1_000
STEPS = ("plan", "killed", "ingest", "encode", "verify", "random")


def main() -> None:
    """Print a line for each step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=int)
    parser.add_argument("--events", type=int, default=200, help="of a recording")
    parser.add_argument("--contents", type=int, default=1_000, help="recordings that differ")
    parser.add_argument("--folder", type=Path, help="where the files are made; without, where temporary files are")
    parser.add_argument("--no-kill", action="store_true", help="ingest in one go")
    parser.add_argument("--json", action="store_true", help="all that was found, as the last line")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.step:
        os.environ["CTLEV_HOME"] = str(chosen.folder / "home")
        print(json.dumps(run_step(chosen.step, chosen.folder)))
        return
    with tempfile.TemporaryDirectory(dir=chosen.folder) as name:
        folder = Path(name)
        start = time.perf_counter()
        write_recordings(folder / "raw", chosen.recordings, chosen.events, chosen.contents)
        print(
            f"{chosen.recordings} recordings of {chosen.events} events, written in {time.perf_counter() - start:.0f} s"
        )
        print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, CTLEV_WORKERS={os.environ.get('CTLEV_WORKERS')}")
        print(f"{'':8}{'clock s':>9}{'CPU s':>9}{'us each':>9}{'peak MiB':>10}")
        all_found: dict[str, dict[str, Any]] = {}
        for step in STEPS:
            if step == "killed" and chosen.no_kill:
                continue
            found = all_found[step] = in_process(step, folder, chosen.recordings)
            each = 1e6 * found["cpu_s"] / (RANDOM_READS if step == "random" else chosen.recordings)
            print(
                f"{step:8}{found['wall_s']:9.1f}{found['cpu_s']:9.1f}{each:9.0f}{found['peak_mib']:10.0f}  "
                + found.get("note", ""),
                flush=True,
            )
        if chosen.json:
            print(json.dumps(all_found))


def write_recordings(root: Path, count: int, num_events: int, num_contents: int, classes: int = 0) -> None:
    """`count` recordings in N-ImageNet's layout, a tenth of them to test on: a bright edge before a moving camera.

    `classes`: how many; 0 = one for each 1,500 recordings.
    """
    contents = root / "contents"
    contents.mkdir(parents=True)
    num_contents = min(num_contents, count)
    for number in range(num_contents):
        random = np.random.default_rng(number)
        t_us = np.sort(random.integers(0, 50_000, num_events))
        place, speed = random.uniform(100, 400), random.uniform(500, 3_000)
        columns = {
            "x_pos": (place + speed * t_us / 1e6 + random.normal(0, 1, num_events)).astype(np.uint16),
            "y_pos": random.integers(0, SENSOR_SIZE[1], num_events).astype(np.uint16),
            "timestamp": t_us,
            "polarity": random.random(num_events) < 0.8,
        }
        np.savez_compressed(contents / f"{number}.npz", **columns)
    classes = classes or max(round(count / PER_CLASS), 1)
    names = "".join(f"n{number:08d} thing {number}\n" for number in range(classes))
    (root / "LOC_synset_mapping.txt").write_text(names, encoding="utf-8")
    for place in ("extracted_train", "extracted_val"):
        for number in range(classes):
            (root / place / f"n{number:08d}").mkdir(parents=True)
    per_class = count // classes
    learnt_from = per_class - max(per_class // 10, 1)
    for number in range(count):
        place = "extracted_val" if number // classes >= learnt_from else "extracted_train"
        folder = root / place / f"n{number % classes:08d}"
        copy, content = divmod(number, num_contents)
        if copy % 50_000 == 0 and copy:  # a file system allows so many links
            (contents / f"{content}.npz").write_bytes((contents / f"{content}.npz").read_bytes())
        os.link(contents / f"{content}.npz", folder / f"{number}.npz")


def in_process(step: str, folder: Path, count: int) -> dict[str, Any]:
    """What a step says of itself; `killed` is watched, and killed."""
    command = [sys.executable, str(Path(__file__).resolve()), str(count), "--folder", str(folder), "--step", step]
    if step == "killed":
        return kill_when_half_done(command, folder, count)
    finished = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if finished.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit status {finished.returncode}")
    return json.loads(finished.stdout.splitlines()[-1])


def kill_when_half_done(command: list[str], folder: Path, count: int) -> dict[str, Any]:
    """Kill `ingest` when it has read half of all recordings, as far as finished groups of them tell."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    work = folder / "home" / "work"
    while process.poll() is None:
        time.sleep(0.2)
        tables = list(work.glob("*/*/recordings.parquet"))
        if sum(count_rows(path) for path in tables) >= count / 2:
            process.send_signal(signal.SIGKILL)
            break
    _, _, used = os.wait4(process.pid, 0)
    process.returncode = -signal.SIGKILL
    return {
        "wall_s": time.perf_counter() - start,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mib": used.ru_maxrss / 1024,
        "note": f"{len(tables)} groups finished",
    }


def count_rows(path: Path) -> int:
    """Rows of a table, of which only the end of the file is read."""
    import pyarrow.parquet as pq

    return pq.read_metadata(path).num_rows


def run_step(step: str, folder: Path) -> dict[str, Any]:
    """Do it, and say what it took."""
    begin_memory_peak()
    wall, cpu = time.perf_counter(), time.process_time()
    found = globals()[f"do_{step}"](folder)
    took = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu, "peak_mib": memory_peak_mib()}
    return took | found


def dataset_of(folder: Path) -> DatasetChoice:
    """All recordings of the folder."""
    return DatasetChoice(name="n_imagenet", options={"root": str(folder / "raw"), "images_per_class": None})


def run_stage(stage: Stage, **arguments: Any) -> ManifestRef:
    """What a Prefect task does, without Prefect."""
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def do_plan(folder: Path) -> dict[str, Any]:
    """List, hash, calculate the key."""
    ingest.key({"dataset": dataset_of(folder)}, Store())
    return {}


def do_killed(folder: Path) -> dict[str, Any]:
    """Ingest; whoever started this process kills it."""
    return do_ingest(folder)


def do_ingest(folder: Path) -> dict[str, Any]:
    """Ingest, and count what there is then."""
    return keep(folder, "recordings", run_stage(ingest, dataset=dataset_of(folder)))


def do_encode(folder: Path) -> dict[str, Any]:
    """Encode each recording as a whole."""
    encoding = EncodingChoice(name="event_histogram", options={"image_size": (64, 64), "resampling": "events"})
    recordings = kept(folder, "recordings")
    made = run_stage(encode, recordings=recordings, encoding=encoding, windows=Windows(method="whole"))
    return keep(folder, "frames", made)


def do_verify(folder: Path) -> dict[str, Any]:
    """Hash every file again."""
    for name in ("recordings", "frames"):
        Store().check(kept(folder, name).path)
    return {}


def do_random(folder: Path) -> dict[str, Any]:
    """Read recordings drawn from all; opening the artefact is not counted."""
    recordings = read_manifest(kept(folder, "recordings"))
    rows = np.random.default_rng(0).choice(len(recordings), RANDOM_READS)
    wall, cpu = time.perf_counter(), time.process_time()
    for row in rows.tolist():
        record = recordings.table.slice(row, 1).to_pylist()[0]
        stored_events(recordings, record).read(0, record["num_events"])
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def keep(folder: Path, name: str, made: ManifestRef) -> dict[str, Any]:
    """Remember an artefact for the next step; what it takes on the disk."""
    (folder / f"{name}.json").write_text(made.model_dump_json(), encoding="utf-8")
    files = [path for path in made.path.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    note = f"{made.rows} rows, {len(files)} files, {size / 1e6:.1f} MB"
    return {"note": note, "rows": made.rows, "files": len(files), "bytes": size, "digest": made.digest}


def kept(folder: Path, name: str) -> ManifestRef:
    """What `keep` remembered."""
    return ManifestRef.model_validate_json((folder / f"{name}.json").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
