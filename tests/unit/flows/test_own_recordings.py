"""What is wrong with a folder of recordings is said before anything runs, or where it is read."""

import logging
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from ctlev_core.plugins import PluginError
from data_contracts.config import DatasetChoice
from data_contracts.errors import DataError
from flows.command_line import load_experiment
from flows.inputs import check_num_classes
from tasks.ingest import ingest
from tasks.store import Store

REPOSITORY = Path(__file__).resolve().parents[3]


def write_blob(path, left, top):
    """Events of a blob of a few pixels, as a table without a sensor size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(0)
    x, y = (start + random.integers(0, 8, 200) for start in (left, top))
    rows = np.stack([np.sort(random.integers(0, 100_000, 200)), x, y, random.integers(0, 2, 200)], axis=1)
    np.savetxt(path, rows, "%d", ",", header="t,x,y,p", comments="")


def run_ingest(root, **options):
    arguments = {"dataset": DatasetChoice(name="folder", options={"root": str(root), **options})}
    return ingest.run(ingest.key(arguments, Store()), arguments)


@pytest.mark.usefixtures("home")
def test_sizes_that_differ_are_named_unless_the_camera_is(tmp_path, caplog):
    write_blob(tmp_path / "own" / "near" / "a.csv", 20, 20)
    write_blob(tmp_path / "own" / "far" / "a.csv", 500, 400)
    with caplog.at_level(logging.WARNING):
        run_ingest(tmp_path / "own", sensor_size=(640, 480))
        assert not caplog.messages
        run_ingest(tmp_path / "own")
    (message,) = caplog.messages
    assert "34 x 34 px (1), 640 x 480 px (1), and each is drawn at its own scale" in message
    assert "set dataset.options.sensor_size=[WIDTH,HEIGHT]" in message


def test_a_classifier_of_one_class_is_refused_and_a_generator_is_not(tmp_path):
    write_blob(tmp_path / "zero" / "a.csv", 20, 20)
    experiment = load_experiment("folder", [f"dataset.options.root={tmp_path}"])  # as all that only samples
    with pytest.raises(DataError, match="classifier needs at least two classes, got 'zero' alone"):
        check_num_classes(experiment)
    write_blob(tmp_path / "one" / "a.csv", 20, 20)
    check_num_classes(experiment)


def test_event_streams_of_own_recordings_are_asked_for_as_the_quick_start_says(tmp_path):
    write_blob(tmp_path / "one" / "a.csv", 20, 20)
    page = (REPOSITORY / "docs" / "quick_start.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^- `(--set 'export=[^`]*)`", page, re.MULTILINE)
    root, *options = f"dataset.options.root={tmp_path}", *shlex.split(line.replace("--set ", ""))
    load_experiment("folder", [root, *options])
    with pytest.raises(PluginError, match="averages over areas of sensors whose sizes only their files tell: set"):
        load_experiment("folder", [root, options[0]])
