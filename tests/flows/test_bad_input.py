"""Wrong input ends in one clear line and status 2, before anything long starts; what was computed stays."""

import shutil
import time

import numpy as np
import pytest
from flow_scripts import digests, plan_script, run_script, run_script_here

from data_contracts.events import Events
from flows.command_line import Asked, Command, run_command
from flows.local_server import ServerLostError
from flows.settings import flow
from tasks.runners import WorkerError
from tasks.stage import StageTimeoutError


def refused(home, *arguments, preset="folder", run=plan_script, **how):
    started = time.monotonic()
    finished = run("full_experiment", "--preset", preset, *arguments, home=home, **how)
    assert finished.status == 2, finished.errors
    (line,) = [line for line in finished.errors.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in finished.errors
    assert time.monotonic() - started < 60
    return line, finished.errors


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ("--preset", "nonesuch"),
            "unknown preset 'nonesuch'; known: ablations, aist, all_routes, amass, base_model_over_training, body, ",
        ),
        (
            ("--set", "dataset.options.intensity_rate_hz=null"),
            "baselines.event_gan.condition: needs intensity frames, and dataset 'studio' with these options has none",
        ),
        (
            ("--set", "baselines={synthetic: {condition: {name: skeleton}, generator: {name: controlnet}}}"),
            "a baseline's name is made of a-z, 0-9 and _, and is not recorded or synthetic or ",
        ),
        (("--set", "baselines={test: {generator: {name: smpl_esim}}}"), "a baseline's name is made of a-z, 0-9 and _"),
        (("--set", "metrics=[{name: oks}, {name: oks}]"), "expected each once, got 'oks' twice with the same options"),
        (
            ("--preset", "folder"),
            "datasets 'folder': option 'root' must be a path, got None; --set dataset.options.root=PATH",
        ),
        (("--set", "downstream_seeds=[0,0]"), "expected each once, got 0 twice"),
        (("--set", "nonesuch=1"), "unknown option 'nonesuch'; known: name,"),
        (("--set", "windows.num_events=0"), "option 'windows.num_events': input should be greater than 0, got 0"),
        (("--set", "dataset.options.colour=red"), "datasets 'studio': unknown option 'colour'; known: "),
        (
            ("--set", "dataset.name=dhp91"),
            "unknown plug-in 'dhp91' in datasets; did you mean 'dhp19'?; known: aist, amass, cdehp, dhp19, ",
        ),
        (("--set", "generator.options.num_steps=many"), "generators 'controlnet': option 'num_steps'"),
        (("--set", "sampling.num_inference_steps=0"), "option 'num_inference_steps': input should be greater"),
        (("--set", "name=../X"), "string should match pattern '^[A-Za-z0-9_-][A-Za-z0-9._-]*$', got '../X'"),
        (("--preset", ""), "unknown preset ''; known: ablations, "),
        (("--set", "novalue"), "--set expects key=value, got 'novalue'"),
        (("--set", "generator.options.base_model=/does/not/exist"), "/does/not/exist"),
    ],
)
def test_wrong_command_line(tmp_path, arguments, expected):
    line, _ = refused(tmp_path, *arguments, "--dry-run", preset="smoke")
    assert expected in line
    assert not (tmp_path / "artefacts").exists()


def test_wrong_option_stops_a_real_run_too(tmp_path):
    line, _ = refused(tmp_path, "--set", "num_synthetic=-5", preset="smoke", run=run_script, own_server=True)
    assert "option 'num_synthetic': input should be greater than 0, got -5" in line
    assert not (tmp_path / "artefacts").exists()


def test_home_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    finished = plan_script(
        "full_experiment", "--preset", "smoke", "--home", str(tmp_path / "file" / "x"), home=tmp_path
    )
    assert finished.status == 2 and "the home folder cannot be written" in finished.errors


def make_recording(path, *, t=None, x=None):
    from ctlev_core.formats import evt2

    path.parent.mkdir(parents=True, exist_ok=True)
    count = 5000
    random = np.random.default_rng(1)
    events = Events(
        np.arange(count, dtype=np.int64) * 10 if t is None else t,
        random.integers(0, 320, count).astype(np.uint16) if x is None else x,
        random.integers(0, 240, count).astype(np.uint16),
        random.integers(0, 2, count).astype(np.uint8),
        (320, 240),
    )
    evt2.write(path, events)


def test_missing_root_and_empty_folder(tmp_path):
    line, errors = refused(tmp_path / "home", "--set", f"dataset.options.root={tmp_path / 'absent'}")
    assert "absent" in line and "person/" in errors  # shows the tree that is expected
    (tmp_path / "empty").mkdir()
    line, _ = refused(tmp_path / "home", "--set", f"dataset.options.root={tmp_path / 'empty'}")
    assert "no class folders" in line


def test_unknown_extension_and_truncated_file(tmp_path):
    root = tmp_path / "data"
    make_recording(root / "a" / "one.raw")
    (root / "b").mkdir()
    (root / "b" / "notes.docx").write_bytes(b"not events")
    line, _ = refused(tmp_path / "home", "--set", f"dataset.options.root={root}")
    assert "notes.docx" in line and "known formats" in line
    (root / "b" / "notes.docx").unlink()
    make_recording(root / "b" / "two.raw")
    content = (root / "b" / "two.raw").read_bytes()
    (root / "b" / "two.raw").write_bytes(content[:-3])
    line, _ = refused(tmp_path / "home", "--set", f"dataset.options.root={root}", run=run_script_here)
    assert "two.raw" in line


def parquet_recording(path, **changed):
    import pyarrow as pa
    import pyarrow.parquet as pq

    from ctlev_core.formats import parquet

    make_recording(path.with_suffix(".raw"))
    from ctlev_core.events import files as event_files

    events = event_files.read_events_file(path.with_suffix(".raw"))
    path.with_suffix(".raw").unlink()
    parquet.write(path, events)
    table = pq.read_table(path)
    for name, values in changed.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values, table[name].type))
    pq.write_table(table, path)


@pytest.mark.parametrize(
    ("column", "change", "expected"),
    [
        ("t", lambda t: t[::-1].copy(), "t decreases at event 1"),
        ("t", lambda t: t - 100, "time stamps must not be negative, got t = -100 us at event 0"),
        ("x", lambda x: x + 320, "x must be below 320"),
    ],
)
def test_events_that_break_their_promises(tmp_path, column, change, expected):
    root = tmp_path / "data"
    make_recording(root / "a" / "one.raw")
    parquet_recording(root / "b" / "two.parquet")
    import pyarrow.parquet as pq

    values = pq.read_table(root / "b" / "two.parquet")[column].to_numpy()
    parquet_recording(root / "b" / "two.parquet", **{column: change(values)})
    line, _ = refused(tmp_path / "home", "--set", f"dataset.options.root={root}", run=run_script_here)
    assert expected in line and "two" in line


def test_what_was_computed_stays(smoke_home, tmp_path):
    home = shutil.copytree(smoke_home, tmp_path / "home")
    before = digests(home)
    refused(home, "--set", "generator.options.batch_size=0", preset="smoke")
    line, _ = refused(home, "--set", "encoding.options.image_size=[48,48]", preset="smoke", run=run_script_here)
    assert "this base model makes images of 64 x 64 px, event images are 48 x 48 px" in line
    assert before.items() <= digests(home).items()
    assert not list((home / "tmp").iterdir())


def test_a_dry_run_finds_recordings_that_are_cut(tmp_path):
    (tmp_path / "mine" / "walk").mkdir(parents=True)
    for name in ("a", "b", "c"):
        np.save(tmp_path / "mine" / "walk" / f"{name}.npy", np.tile([1.0, 2.0, 3.0, 1.0], (50, 1)))
    cut = tmp_path / "mine" / "walk" / "b.npy"
    cut.write_bytes(cut.read_bytes()[:-5])
    settings = ("--set", f"dataset.options.root={tmp_path / 'mine'}", "--dry-run")
    refused = plan_script("synthesize", "--preset", "folder", *settings, home=tmp_path / "home")
    assert refused.status == 2 and refused.errors.count(".npy") == 1
    assert f"{cut}: not a complete NumPy file" in refused.errors


def test_a_dry_run_says_what_an_export_would_write(tmp_path):
    def plan(flow, setting):
        return plan_script(flow, "--preset", "smoke", "--set", setting, "--dry-run", home=tmp_path).output

    folder, events = tmp_path / "out", tmp_path / "events" / "smoke"
    assert f"would write to {folder}: at most 8 images, without those" in plan("synthesize", f"export_folder={folder}")
    told = plan("export_events", "export.one_file=true")
    assert f"would write to {events}: at most 8 event streams, one file, as parquet" in told


@pytest.mark.parametrize(
    "lost", [WorkerError("a process ended"), StageTimeoutError("too long"), ServerLostError("gone")]
)
def test_what_a_run_has_lost_is_told_in_one_line(home, capsys, lost):
    def fail(_):
        raise lost

    home.mkdir(exist_ok=True)
    command = Command(flow(name="failing")(fail), lambda *_: "", load=lambda *_: None)
    assert run_command(command, Asked("", [], dry_run=True)) == 2
    assert capsys.readouterr().err == f"error: {lost}\n"
