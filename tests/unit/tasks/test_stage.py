"""Keys, caching, crashes and provenance of a stage, without Prefect."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pytest
from pydantic import Field

from ctlev_core import plugins
from ctlev_core.plugins import PluginError
from data_contracts import tables
from data_contracts.config import RUN_SETTING, DatasetChoice, Frozen, Windows, cache_material
from data_contracts.errors import DataError
from data_contracts.file_lists import files_of
from data_contracts.manifest import read_manifest, write_manifest
from data_contracts.run_record import read_run_record, write_run_record
from tasks import workers
from tasks.stage import Output, in_one_run, planning, stage
from tasks.store import Store


def curve(losses):
    steps = range(len(losses))
    return pa.table(
        {
            "curve": pa.array(["training"] * len(losses)),
            "step": pa.array(list(steps), pa.int64()),
            "loss": pa.array([float(loss) for loss in losses], pa.float64()),
        }
    )


calls = []


@stage(version=1, schema=tables.TRAINING)
def first(out, *, windows, seed=0):
    """Writes an array and a table."""
    calls.append("first")
    out.write_array("frames", np.full((2, 3), seed))
    return curve([seed, windows.num_events])


@stage(version=1, schema=tables.TRAINING)
def second(out, source):
    """Depends on `first`."""
    calls.append("second")
    return curve([sum(source.column("loss"))])


def run(a_stage, *inputs, **settings):
    """What a Prefect task does, without Prefect."""
    bound = a_stage.signature.bind(None, *inputs, **settings)
    bound.apply_defaults()
    arguments = dict(list(bound.arguments.items())[1:])
    return a_stage.run(a_stage.key(arguments, Store()), arguments)


@pytest.fixture(autouse=True)
def _forget(home):
    calls.clear()


def test_second_run_is_cached_and_equal():
    ref, cached = run(first, windows=Windows())
    again, cached_again = run(first, windows=Windows())
    assert (cached, cached_again) == (False, True)
    assert again == ref and calls == ["first"]


def test_key_depends_on_options_seed_version_and_upstream():
    def key(a_stage, *inputs, **settings):
        with planning() as rows:
            a_stage(*inputs, **settings)
        return rows[0].key

    base = key(first, windows=Windows())
    assert key(first, windows=Windows()) == base
    assert key(first, windows=Windows(num_events=1)) != base
    assert key(first, windows=Windows(), seed=1) != base
    first.version = 2
    try:
        assert key(first, windows=Windows()) != base
    finally:
        first.version = 1
    ref, _ = run(first, windows=Windows())
    other, _ = run(first, windows=Windows(num_events=1))
    assert key(second, ref) != key(second, other)


@dataclass(frozen=True)
class Pair:
    """Artefacts in a record."""

    name: str
    sources: tuple


@stage(version=1, schema=tables.TRAINING)
def of_record(out, pair):
    """Depends on what is in a record."""
    calls.append(pair.name)
    return curve([sum(one.column("loss")) for one in pair.sources])


def test_records_of_artefacts_are_opened_and_enter_the_key():
    refs = [run(first, windows=Windows(), seed=seed)[0] for seed in (1, 2)]
    losses = [sum(read_manifest(ref).column("loss")) for ref in refs]
    made, cached = run(of_record, Pair("both", tuple(refs)))
    assert not cached and calls[-1] == "both" and read_manifest(made).column("loss") == losses
    assert run(of_record, Pair("both", tuple(refs))) == (made, True)
    assert read_run_record(made.path).upstream == {ref.key: ref.digest for ref in refs}
    for other in (Pair("both", tuple(refs[:1])), Pair("one", tuple(refs))):
        assert run(of_record, other)[0].key != made.key


def test_run_settings_stay_outside_the_key():
    class Options(Frozen):
        path: str = Field("a", json_schema_extra=RUN_SETTING)
        size: int = 1

    assert cache_material(Options(path="b")) == cache_material(Options(path="a")) == {"size": 1}


def test_planning_computes_nothing_and_knows_every_key():
    with planning() as rows:
        second(first(windows=Windows()))
    assert calls == [] and [row.cached for row in rows] == [False, False]
    ref, _ = run(first, windows=Windows())
    done, _ = run(second, ref)
    with planning() as rows_after:
        second(first(windows=Windows()))
    assert [row.cached for row in rows_after] == [True, True]
    assert [row.key for row in rows_after] == [row.key for row in rows] == [ref.key, done.key]


DAMAGE = {
    "removed": shutil.rmtree,
    "a file cut short": lambda folder: os.truncate(folder / "frames.npy.zst", 10),
    "another manifest": lambda folder: os.truncate(folder / "manifest.parquet", 10),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_in_one_run_only_what_is_gone_since_the_plan_is_a_task(monkeypatch, damage):
    tasks = []

    def run_as_task(name, label, work):
        tasks.append(label)
        return work()[0]

    monkeypatch.setattr("tasks.stage.run_as_task", run_as_task)
    source = first(windows=Windows(), label="data")
    made = second(source)
    assert tasks == ["first: data", "second"]
    with planning() as rows, in_one_run():
        second(first(windows=Windows()))
    assert all(row.cached for row in rows)
    with in_one_run():
        assert second(first(windows=Windows())) == made
    assert tasks == ["first: data", "second"]
    DAMAGE[damage](source.path)
    with in_one_run():
        assert second(first(windows=Windows(), label="again")) == made
    assert tasks[2:] == ["first: again"] and calls == ["first", "second", "first"]


class OneProcess:
    """In the place of `tasks.workers`: computes here, one call after the other."""

    def __init__(self):
        self.calls, self.begun, self.go_on = [], threading.Event(), threading.Event()

    def call(self, function, module, name, key, arguments, asked):
        self.calls.append(name)
        self.begun.set()
        assert self.go_on.wait(30)
        with no_workers():
            return {"first": first, "second": second}[name].run(key, arguments)


@contextlib.contextmanager
def no_workers():
    token = workers._current.set(None)
    try:
        yield
    finally:
        workers._current.reset(token)


def test_who_waits_for_an_artefact_takes_no_process_from_others():
    source, _ = run(first, windows=Windows())
    process = OneProcess()
    token = workers._current.set(process)
    try:
        with ThreadPoolExecutor(3) as threads:
            asked = [threads.submit(copy_context().run, run, second, source)]
            assert process.begun.wait(30)
            asked.append(threads.submit(copy_context().run, run, second, source))
            other = threads.submit(copy_context().run, run, first, windows=Windows(), seed=1)
            deadline = time.monotonic() + 30
            while len(process.calls) < 2 and time.monotonic() < deadline:
                time.sleep(0.01)
            assert process.calls == ["second", "first"], "the second who asks for `second` waits outside"
            process.go_on.set()
            made, found = (call.result() for call in asked)
        assert made[0] == found[0] and (made[1], found[1]) == (False, True)
        assert not other.result()[1]
        assert sorted(calls) == ["first", "first", "second"]
    finally:
        workers._current.reset(token)


def test_damaged_artefact_is_set_aside_and_made_anew(home):
    ref, _ = run(first, windows=Windows())
    (ref.path / "frames.npy.zst").write_bytes(b"short")
    again, cached = run(first, windows=Windows())
    assert not cached and again.digest == ref.digest
    assert len(list((home / "damaged" / "first").iterdir())) == 1


def test_artefact_of_changed_input_is_made_anew():
    source, _ = run(first, windows=Windows(), seed=1)
    doubled, _ = run(second, source)
    run(second, doubled)
    # The input is repeated and comes out differently, as a training run may on another machine.
    manifest = source.path / "manifest.parquet"
    manifest.unlink()
    changed = write_manifest(source.path, curve([7, 7]), tables.TRAINING)
    written = read_run_record(source.path)
    write_run_record(source.path, written.model_copy(update={"digest": changed.digest}))
    repeated, cached = run(first, windows=Windows(), seed=1)
    assert cached and repeated.digest != source.digest
    with planning() as rows:
        of_second = second(first(windows=Windows(), seed=1))
        second(of_second)
    assert [row.cached for row in rows] == [True, False, False], "what depends on it will be another, too"
    made, cached = run(second, repeated)
    assert not cached and read_manifest(made).column("loss") == [14.0]
    with planning() as rows:
        second(first(windows=Windows(), seed=1))
    assert [row.cached for row in rows] == [True, True]


def test_work_of_a_killed_run_is_kept_for_the_same_inputs_alone(home):
    @stage(version=1, schema=tables.TRAINING)
    def resumes(out, source):
        """Fails after its first half, which it keeps."""
        state = out.work / "half"
        if not state.exists():
            state.write_text(str(sum(source.column("loss"))))
            raise InterruptedError
        return curve([float(state.read_text())])

    def changed(ref, losses):
        (ref.path / "manifest.parquet").unlink()
        digest = write_manifest(ref.path, curve(losses), tables.TRAINING).digest
        write_run_record(ref.path, read_run_record(ref.path).model_copy(update={"digest": digest}))
        return run(first, windows=Windows(), seed=1)[0]

    source, _ = run(first, windows=Windows(), seed=1)
    with pytest.raises(InterruptedError):
        run(resumes, source)
    other = changed(source, [7, 7])
    for _ in range(2):
        with contextlib.suppress(InterruptedError):
            made, cached = run(resumes, other)
    assert not cached and read_manifest(made).column("loss") == [14.0]


@pytest.mark.parametrize("links", [True, False])
def test_a_shared_file_stays_in_the_work_folder(links, tmp_path, monkeypatch):
    def refuse(source, target):
        raise PermissionError(1, "Operation not permitted")  # what file systems without links say

    if not links:
        monkeypatch.setattr(os, "link", refuse)
    (tmp_path / "made").mkdir()
    finished = tmp_path / "finished.bin"
    finished.write_bytes(b"events")
    Output(tmp_path / "made", tmp_path).share(finished, "events/shared.bin")
    assert (tmp_path / "made/events/shared.bin").read_bytes() == finished.read_bytes() == b"events"


def test_failure_publishes_nothing(home):
    @stage(version=1, schema=tables.TRAINING)
    def fails(out):
        """Breaks its schema."""
        (out.work / "state").write_text("kept")
        return curve([float("nan")])

    with pytest.raises(DataError, match="column 'loss', row 0: expected a finite number"):
        run(fails)
    assert not (home / "artefacts" / "fails").exists()
    assert [path.read_text() for path in (home / "work").rglob("state")] == ["kept"]


def test_provenance_record():
    source, _ = run(first, windows=Windows(num_events=5), seed=3)
    ref, _ = run(second, source)
    record = json.loads((ref.path / "run.json").read_text())
    assert record["upstream"] == {source.key: source.digest}
    assert record["digest"] == ref.digest and record["stage_version"] == 1
    assert record["wall_seconds"] >= 0 and record["process_peak_memory_mib"] > 1
    assert record["rows"] == ref.rows == len(read_manifest(ref).table)
    assert record["versions"]["numpy"] == np.__version__
    arguments = json.loads((source.path / "run.json").read_text())["arguments"]
    assert arguments["seed"] == 3 and arguments["windows"]["num_events"] == 5


def test_stage_argument_of_unknown_kind_is_refused():
    with pytest.raises(DataError, match="must be a manifest, options, a plain value or a record of these, got set"):
        run(second, {1, 2})


def test_unknown_plugin_in_an_argument_is_refused():
    @stage(version=1, schema=tables.TRAINING)
    def uses(out, *, dataset):
        """Names a plug-in."""
        return curve([0])

    with pytest.raises(PluginError, match="unknown plug-in 'nonesuch' in datasets; known: aist, amass, cdehp"):
        run(uses, dataset=DatasetChoice(name="nonesuch"))


SLOW_STAGE = """
    import sys, time
    import numpy as np, pyarrow as pa
    from data_contracts import tables
    from tasks.stage import stage
    from tasks.store import Store

    @stage(version=1, schema=tables.TRAINING)
    def slow(out, *, seed=0):
        out.write_array("frames", np.zeros(1000))
        (out.work / "checkpoint").write_text("half way")
        print("started", flush=True)
        time.sleep(float(sys.argv[1]))
        return pa.table({"curve": ["training"], "step": pa.array([0], pa.int64()), "loss": pa.array([0.0])})

    ref, cached = slow.run(slow.key({"seed": 0}, Store()), {"seed": 0})
    print(ref.digest, cached, flush=True)
"""


def start_slow(seconds):
    command = [sys.executable, "-c", textwrap.dedent(SLOW_STAGE), str(seconds)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ)


def test_killed_stage_leaves_no_artefact_and_can_be_run_again(home):
    process = start_slow(60)
    assert process.stdout.readline() == "started\n"
    process.kill()
    process.wait()
    assert not (home / "artefacts").exists()
    assert [path.read_text() for path in (home / "work").rglob("checkpoint")] == ["half way"]
    process = start_slow(0)
    output, _ = process.communicate(timeout=60)
    assert output.splitlines()[1].endswith("False")
    assert not list((home / "tmp").iterdir()) and not list((home / "work").iterdir())


def test_two_processes_make_an_artefact_once():
    started = time.monotonic()
    processes = [start_slow(2), start_slow(2)]
    outputs = [process.communicate(timeout=60)[0].splitlines() for process in processes]
    assert sorted(line.split()[1] for lines in outputs for line in lines if line != "started") == ["False", "True"]
    assert sum(lines.count("started") for lines in outputs) == 1
    assert time.monotonic() - started < 50


def test_content_of_raw_folders_enters_the_key_and_their_place_does_not(tmp_path):
    def key(*folders):
        reads = stage(version=1, schema=tables.TRAINING, raw_files=lambda arguments: files_of(folders))(first.function)
        return reads.key({"windows": Windows(), "seed": 0}, Store())

    for name, content in (("a", "one"), ("b", "one"), ("c", "two")):
        (tmp_path / name / "unet").mkdir(parents=True)
        (tmp_path / name / "unet" / "config.json").write_text(content)
    assert key(tmp_path / "a") == key(tmp_path / "b") != key(tmp_path / "c")
    assert key(tmp_path / "a", tmp_path / "b") != key(tmp_path / "a")


def test_raw_files_that_change_while_they_are_read_are_an_error(home, tmp_path):
    file = tmp_path / "recording"
    file.write_text("one")

    def reads(out):
        (out.work / "shard").write_text(file.read_text())
        file.write_text("another")
        return curve([1.0])

    reading = stage(version=1, schema=tables.TRAINING, raw_files=lambda arguments: [("recording", file)])(reads)
    with pytest.raises(DataError, match="reads: raw files have changed while they were read; run again"):
        run(reading)
    assert not (home / "artefacts").exists() and not list((home / "work").rglob("shard"))
    _, cached = run(reading)
    assert not cached


def test_linked_folders_are_read_and_loops_are_not(tmp_path):
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / "weights").write_bytes(b"1")
    model = tmp_path / "model"
    (model / "vae").mkdir(parents=True)
    (model / "unet").symlink_to(tmp_path / "shared")
    (model / "vae" / "loop").symlink_to(model)
    assert [name for name, _ in files_of([model])] == ["0/unet/weights"]


def test_a_folder_that_two_links_lead_to_is_read_in_both_places(tmp_path):
    (tmp_path / "shared" / "vae").mkdir(parents=True)
    (tmp_path / "shared" / "vae" / "weights").write_bytes(b"1")
    for name in ("a", "b"):
        (tmp_path / "models" / name).mkdir(parents=True)
        (tmp_path / "models" / name / "vae").symlink_to(tmp_path / "shared" / "vae")
    assert [name for name, _ in files_of([tmp_path / "models"])] == ["0/a/vae/weights", "0/b/vae/weights"]
    (tmp_path / "models" / "b" / "vae").unlink()
    assert [name for name, _ in files_of([tmp_path / "models"])] == ["0/a/vae/weights"]
    # In one another: whoever walks on and on never comes back.
    (tmp_path / "models" / "a" / "other").symlink_to(tmp_path / "models" / "b")
    (tmp_path / "models" / "b" / "other").symlink_to(tmp_path / "models" / "a")
    assert [name for name, _ in files_of([tmp_path / "models"])] == ["0/a/vae/weights", "0/b/other/vae/weights"]
    assert files_of([tmp_path / "nothing"]) == []


def test_versions_of_readers_enter_the_key_of_stages_that_read_files(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"1")
    keys = []
    for files in ([("a", tmp_path / "a")], []):
        made = stage(version=1, schema=tables.TRAINING, raw_files=lambda _, f=files: f, readers=("formats",))
        reads = made(first.function)
        for version in (1, 2):
            monkeypatch.setattr(plugins, "versions", lambda kind, v=version: {"evt3": v})
            keys.append(reads.key({"windows": Windows(), "seed": 0}, Store()))
    assert keys[0] != keys[1] and keys[2] == keys[3]


@stage(version=1, schema=tables.TRAINING, optional=("more",))
def grown(out, *, seed, more=None):
    """Has had an option more for a while."""
    return curve([seed])


def test_an_optional_argument_that_is_not_given_leaves_key_and_record_as_they_were():
    @stage(version=1, schema=tables.TRAINING)
    def before(out, *, seed):
        return curve([seed])

    before.name = grown.name
    assert grown.key({"seed": 1, "more": None}, Store()) == before.key({"seed": 1}, Store())
    assert grown.key({"seed": 1, "more": 2}, Store()) != before.key({"seed": 1}, Store())
    made, _ = run(grown, seed=1)
    assert read_run_record(made.path).arguments == {"seed": 1}
