"""Motion files of any known format: which format a file has, and the motion in it."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from ctlev_core import plugins
from ctlev_core.body.motion.clip import MotionClip
from ctlev_core.plugin_contracts import MotionFormatWithoutRate
from data_contracts.errors import DataError, DetailedDataError


def list_formats() -> dict[str, ModuleType]:
    """Every format plug-in of motions, by name."""
    return {name: plugins.load("motions", name) for name in plugins.names("motions")}


def find_format(path: Path) -> ModuleType | None:
    """The one format plug-in whose `sniff` recognises the file's content; None where none does.

    Formats whose files carry a signature are asked first, all of them. Those without (`HAS_SIGNATURE = False`: arrays
    without names) recognise what is merely plausible; they are asked only where no signature is found.

    Raises:
        DataError: no such file, or not to be read; or several formats recognise it, then it names them.
    """
    if not path.is_file():
        raise DataError(f"{path}: expected a motion file, got {'a folder' if path.is_dir() else 'nothing there'}")
    return plugins.recognise(list_formats(), path)


def read_motion(path: Path, rate_hz: float | None = None) -> MotionClip:
    """The motion in a file of any known format, every frame, checked: metres, y up, SMPL's 24 joints.

    Args:
        path: the file.
        rate_hz: frames a second of a file that does not say; None = what its format assumes.
    Raises:
        DataError: see `find_format` and the format's own `read`; or no format recognises the file, then the message
            lists the known ones, and says what those of its suffix have against it.
    """
    module = find_format(path)
    if module is None:
        known = ", ".join(f"{name} ({', '.join(module.SUFFIXES)})" for name, module in list_formats().items())
        size = path.stat().st_size
        raise DetailedDataError(
            f"{path}: not a motion file of a known format ({size} bytes); known formats: {known}{_objections(path)}"
        )
    if rate_hz is not None and isinstance(module, MotionFormatWithoutRate):
        return module.read(path, rate_hz)
    return module.read(path)


def _objections(path: Path) -> str:
    """Why the formats with the file's suffix do not read it."""
    reasons = ""
    for name, module in list_formats().items():
        if path.suffix.lower() in module.SUFFIXES:
            try:
                module.read(path)
            except DataError as error:
                reasons += f"; {name}: {str(error).removeprefix(f'{path}: ')}"
    return reasons
