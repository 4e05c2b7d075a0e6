"""The content-addressed store: where artefacts live, how they appear all at once, and who may write.

<home>/artefacts/<stage>/<key>/   finished artefacts: manifest.parquet, run.json, arrays, checkpoints
<home>/work/<key>/                resumable state of a stage that is running or was interrupted
<home>/tmp/<key>/                 an artefact being put together; renamed into place when complete
<home>/locks/<key>                held (flock) while a process makes the artefact; freed by the kernel on death
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from data_contracts.errors import DataError
from data_contracts.manifest import RUN_FILE, ManifestRef, file_digest, read_manifest


def home_folder() -> Path:
    """Folder of all state: `CTLEV_HOME`, by default `.ctlev` in the working directory."""
    return Path(os.environ.get("CTLEV_HOME", ".ctlev")).absolute()


class Store:
    """Finished artefacts by stage and key under one home folder."""

    def __init__(self, home: Path | None = None) -> None:
        self.home = home or home_folder()

    def folder(self, stage: str, key: str) -> Path:
        """Where the artefact is, or will be."""
        return self.home / "artefacts" / stage / key

    def work_folder(self, key: str) -> Path:
        """Resumable state that outlives a killed run."""
        return self.home / "work" / key

    def temporary_folder(self, key: str) -> Path:
        """Where an artefact is put together, on the same disk as its final place."""
        return self.home / "tmp" / key

    def find(self, stage: str, key: str) -> ManifestRef | None:
        """The finished artefact, or None. A damaged one is moved aside, so that it is made anew."""
        folder = self.folder(stage, key)
        if not folder.exists():
            return None
        try:
            record = json.loads((folder / RUN_FILE).read_text())
            ref = ManifestRef(key=key, path=folder, digest=record["digest"])
            return read_manifest(ref).ref
        except (DataError, OSError, KeyError, ValueError):
            self.set_aside(folder)
            return None

    def set_aside(self, folder: Path) -> None:
        """Move a damaged or outdated artefact out of the way without deleting it."""
        target = self.home / "damaged" / folder.parent.name
        target.mkdir(parents=True, exist_ok=True)
        number = sum(1 for _ in target.glob(f"{folder.name}.*"))
        with contextlib.suppress(FileNotFoundError):
            folder.rename(target / f"{folder.name}.{number}")

    def upstream_digests(self, stage: str, key: str) -> dict[str, str]:
        """Digests of the manifests a finished artefact was made from."""
        return json.loads((self.folder(stage, key) / RUN_FILE).read_text())["upstream"]

    @contextlib.contextmanager
    def lock(self, key: str) -> Iterator[None]:
        """Only one process makes an artefact; a second waits here and then finds it finished."""
        path = self.home / "locks" / key
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def publish(self, stage: str, key: str, temporary: Path, record: dict[str, Any]) -> ManifestRef:
        """Write the provenance record, flush everything to disk and rename the folder into place."""
        record["digest"] = file_digest(temporary / "manifest.parquet")
        (temporary / RUN_FILE).write_text(json.dumps(record, indent=2, sort_keys=True, default=str) + "\n")
        _sync_tree(temporary)
        folder = self.folder(stage, key)
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary.rename(folder)
        _sync(folder.parent)
        shutil.rmtree(self.work_folder(key), ignore_errors=True)
        return read_manifest(ManifestRef(key=key, path=folder, digest=record["digest"])).ref


class RawFileDigests:
    """SHA-256 of raw input files, remembered by path, size and modification time.

    Planning an experiment hashes its raw recordings; a second plan must not read them again.
    """

    def __init__(self, home: Path) -> None:
        self.path = home / "raw_file_digests.json"
        self.known: dict[str, list] = {}
        with contextlib.suppress(OSError, ValueError):
            self.known = json.loads(self.path.read_text())
        self.changed = False

    def digest(self, path: Path) -> str:
        """SHA-256 of the file's content."""
        status = path.stat()
        identity = [status.st_size, status.st_mtime_ns, status.st_ino]
        name = str(path.resolve())
        entry = self.known.get(name)
        if entry is None or entry[:3] != identity:
            entry = [*identity, file_digest(path)]
            self.known[name] = entry
            self.changed = True
        return entry[3]

    def save(self) -> None:
        """Write what was learnt, atomically."""
        if not self.changed:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.path.with_suffix(f".{os.getpid()}.tmp")
        temporary.write_text(json.dumps(self.known))
        temporary.replace(self.path)
        self.changed = False


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_tree(folder: Path) -> None:
    for path in [*folder.rglob("*"), folder]:
        _sync(path)
