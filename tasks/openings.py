"""How many experiments were scored on the same test frames.

Whoever chooses options by test scores makes these scores too good. A run cannot see what its scores are used for, but
it can count: the home folder has, for each set of test frames, a line for each experiment with other options or seeds;
a home in a bucket has an object for each.
"""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa

from ctlev_core import plugins
from data_contracts.config import Choice, SamplingChoice, cache_material
from data_contracts.experiment import Experiment
from data_contracts.manifest import Manifest
from tasks.bucket import bucket_of
from tasks.stage import is_planning

FOLDER = "test_sets"
_SAYS_NOTHING = ("name", "data_notice")


def test_set_digest(frames: Manifest) -> str:
    """Of the held-out rows of recorded frames: which recordings, windows and labels they are of.

    Neither how many frames are learnt from nor how events are drawn makes them another test set.
    """
    table = frames.table.take(frames.rows_where(split=frames.held_out)).combine_chunks().replace_schema_metadata(None)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return hashlib.sha256(sink.getvalue()).hexdigest()


def note_opening(home: Path, test_set: str, experiment: Experiment) -> int | None:
    """Note that an experiment is scored on test frames, and count the experiments that were.

    Args:
        home: folder of the store.
        test_set: `test_set_digest` of the frames.
        experiment: the same one twice is noted once.
    Returns:
        Experiments with different options or seeds, this one among them; None while stages are only planned.
    Raises:
        OSError: the home cannot be written.
        BucketError: nor can the bucket.
    """
    if is_planning():
        return None
    material = cache_material(experiment, of_choice=_of_choice)
    sampling = SamplingChoice(name=experiment.generator.name, options=dict(experiment.sampling))
    material["sampling"] = _of_choice(sampling)
    material = {name: value for name, value in material.items() if name not in _SAYS_NOTHING}
    options = hashlib.sha256(json.dumps(material, sort_keys=True).encode()).hexdigest()[:32]
    line = {"options": options, "experiment": experiment.name, "time": datetime.now(UTC).isoformat("T", "seconds")}
    bucket = bucket_of(home)
    if bucket is not None:
        # An object for each line: machines side by side do not overwrite one another's, and the first one stays.
        bucket.create(f"{FOLDER}/{test_set}/{options}.json", f"{json.dumps(line)}\n".encode())
        return len(bucket.list(f"{FOLDER}/{test_set}"))
    file = home / FOLDER / f"{test_set}.jsonl"
    text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    known = _read_options(text)
    if options not in known:
        file.parent.mkdir(parents=True, exist_ok=True)
        # One short write at the end of the file: experiments side by side do not mix their lines. Nor does it continue
        # a line that was cut short, by a full disk.
        begin = "" if text.endswith("\n") or not text else "\n"
        with file.open("a", encoding="utf-8") as lines:
            lines.write(f"{begin}{json.dumps(line)}\n")
    return len(known | {options})


def _of_choice(choice: Choice) -> Any:
    """What of a plug-in changes results: neither its device nor an option that is left at its default."""
    plugin = plugins.load_options(choice)
    return {"plugin": f"{plugin.kind}/{plugin.name}", "options": cache_material(plugin.options, _of_choice)}


def _read_options(text: str) -> set[str]:
    """Digests of the lines; a line cut short is passed over."""
    found = set()
    for line in text.splitlines():
        try:
            found.add(json.loads(line)["options"])
        except (ValueError, KeyError, TypeError):
            continue
    return found
