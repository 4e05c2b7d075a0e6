"""The bundled presets, and what the first lines of each say of it. Imports nothing that takes time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PRESETS = Path(__file__).resolve().parent / "presets"
"""Each begins with a line `# Summary: ...` and, for experiments, one `# Time: ...`."""


@dataclass(frozen=True)
class PresetHead:
    """A preset by its name: what it does, and how long that takes; empty where the preset does not say."""

    name: str
    summary: str
    time: str


def preset_names(folder: Path = PRESETS) -> list[str]:
    """Names of the bundled presets of a folder."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def preset_heads(folder: Path = PRESETS) -> list[PresetHead]:
    """What the bundled presets of a folder say of themselves, by name."""
    return [read_head(path) for path in sorted(folder.glob("*.yaml"))]


def read_head(path: Path) -> PresetHead:
    """What a preset says of itself."""
    found = {"Summary": "", "Time": ""}
    for line in path.read_text(encoding="utf-8").splitlines():
        name, separator, text = line.removeprefix("# ").partition(": ")
        if not line.startswith("# ") or not separator or name not in found:
            break
        found[name] = text.strip()
    return PresetHead(path.stem, found["Summary"], found["Time"])
