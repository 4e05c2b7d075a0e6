"""Stand-ins by the names that presets give to what must be downloaded; each is made once and kept."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from data_contracts.errors import DataError

VERSION = 1
"""Of what is written; another one is made anew."""
Size = Literal["full", "tiny"]
SIZES: tuple[Size, ...] = ("full", "tiny")


@dataclass(frozen=True)
class StandIn:
    """How one is made.

    Attributes:
        what: in words.
        file: its name in the folder of its own; empty = the folder itself.
        write: to that place, of that size.
        megabytes: of the size `full`.
        by_size: the sizes differ.
    """

    what: str
    write: Callable[[Path, Size], None]
    megabytes: int
    file: str = ""
    by_size: bool = False


def _network(name: str, *settings: int) -> Callable[[Path, Size], None]:
    def write(place: Path, size: Size) -> None:
        from ctlev_core.stand_ins import networks  # here, for torch takes a second

        getattr(networks, f"write_{name}")(place, size, *settings)

    return write


def _resnet34(place: Path, size: Size) -> None:
    from ctlev_core.stand_ins.networks import write_resnet34

    write_resnet34(place)


def _dataset(name: str) -> Callable[[Path, Size], None]:
    def write(place: Path, size: Size) -> None:
        from ctlev_core.stand_ins import datasets

        getattr(datasets, f"write_{name}")(place)

    return write


STAND_INS: dict[str, StandIn] = {
    "stable_diffusion": StandIn("Stable Diffusion v1", _network("stable_diffusion"), 2140, by_size=True),
    "controlnet_openpose": StandIn("ControlNet v1.0", _network("controlnet", 1), 725, by_size=True),
    "controlnet_normal": StandIn("ControlNet v1.0", _network("controlnet", 2), 725, by_size=True),
    "resnet34": StandIn("ResNet-34", _resnet34, 88),
    "inception": StandIn("Inception v3", _network("inception"), 96, "inception.pt", by_size=True),
    "smpl": StandIn("SMPL's body", _dataset("smpl"), 57, "basicModel_m_lbs_10_207_0_v1.0.0.pkl"),
    "n_imagenet": StandIn("N-ImageNet", _dataset("n_imagenet"), 6),
    "n_caltech101": StandIn("N-Caltech101", _dataset("n_caltech101"), 13),
    "dhp19": StandIn("DHP19", _dataset("dhp19"), 8),
    "cdehp": StandIn("CDEHP", _dataset("cdehp"), 4),
    "event_hpe": StandIn("Event-HPE", _dataset("event_hpe"), 26),
    "amass": StandIn("AMASS", _dataset("amass"), 1),
}


def stand_in_place(name: str, size: Size, folder: Path) -> Path:
    """Where a stand-in lies, made or not."""
    stand_in = STAND_INS[name]
    own = folder / f"{name}{f'-{size}' if stand_in.by_size else ''}-v{VERSION}"
    return own / stand_in.file if stand_in.file else own


def make_stand_in(name: str, size: Size, folder: Path) -> Path:
    """Write a stand-in, whole or not at all; one that is there already is left as it is.

    Args:
        name: a key of `STAND_INS`.
        size: of the networks.
        folder: of all stand-ins.
    Returns:
        The folder or file.
    Raises:
        DataError: the disk has no room for it.
    """
    stand_in, place = STAND_INS[name], stand_in_place(name, size, folder)
    own = place.parent if stand_in.file else place
    if own.is_dir():
        return place
    folder.mkdir(parents=True, exist_ok=True)
    needed, free = int(1.1e6 * stand_in.megabytes), shutil.disk_usage(folder).free
    if size == "full" and free < needed:
        raise DataError(
            f"{folder}: {stand_in.what} of random weights needs {needed / 1e9:.1f} GB, {free / 1e9:.1f} are free"
        )
    temporary = Path(tempfile.mkdtemp(prefix=f"{own.name}.", suffix=".part", dir=folder))
    try:
        written = temporary / own.name
        written.mkdir()
        stand_in.write(written / stand_in.file if stand_in.file else written, size)
        try:
            os.rename(written, own)
        except OSError:  # another process was sooner
            if not own.is_dir():
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return place
