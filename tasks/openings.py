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

from data_contracts.config import cache_material
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from tasks.bucket import bucket_of
from tasks.stage import is_planning

FOLDER = "test_sets"
_SAYS_NOTHING = ("name", "data_notice")


def note_opening(home: Path, frames: ManifestRef, experiment: Experiment) -> int | None:
    """Note that an experiment is scored on test frames, and count the experiments that were.

    Args:
        home: folder of the store.
        frames: recorded frames; what is in them decides, so that a change elsewhere begins no new count.
        experiment: the same one twice is noted once.
    Returns:
        Experiments with different options or seeds, this one among them; None while stages are only planned.
    Raises:
        OSError: the home cannot be written.
        BucketError: nor can the bucket.
    """
    if is_planning():
        return None
    material = {name: value for name, value in cache_material(experiment).items() if name not in _SAYS_NOTHING}
    options = hashlib.sha256(json.dumps(material, sort_keys=True).encode()).hexdigest()[:32]
    line = {"options": options, "experiment": experiment.name, "time": datetime.now(UTC).isoformat("T", "seconds")}
    bucket = bucket_of(home)
    if bucket is not None:
        # An object for each line: machines side by side do not overwrite one another's, and the first one stays.
        bucket.create(f"{FOLDER}/{frames.digest}/{options}.json", f"{json.dumps(line)}\n".encode())
        return len(bucket.list(f"{FOLDER}/{frames.digest}"))
    file = home / FOLDER / f"{frames.digest}.jsonl"
    known = _read_options(file.read_text(encoding="utf-8")) if file.is_file() else set()
    if options not in known:
        file.parent.mkdir(parents=True, exist_ok=True)
        # One short write at the end of the file: experiments side by side do not mix their lines.
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(line) + "\n")
    return len(known | {options})


def _read_options(text: str) -> set[str]:
    """Digests of the lines; a line cut short is passed over."""
    found = set()
    for line in text.splitlines():
        try:
            found.add(json.loads(line)["options"])
        except (ValueError, KeyError, TypeError):
            continue
    return found
