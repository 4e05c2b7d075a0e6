"""Presets that need no downloads: what their `paths` leave open is made, of random weights and made-up recordings.

A study says so with `stand_ins: full`, networks of their published sizes, or `tiny`. What is made lies in the home,
under `stand_ins/`, and is made once.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from ctlev_core.plugins import PluginError
from ctlev_core.stand_ins.making import SIZES, STAND_INS, Size, make_stand_in, stand_in_place
from data_contracts.errors import shortened
from tasks.store import home_folder

# Options that go with a stand-in, of every experiment: a program of ours may run, and small networks take small images.
_OPTIONS: dict[tuple[str, Size], str] = {
    ("inception", "full"): "feature_extractor.options.trusted=true",
    ("inception", "tiny"): "feature_extractor.options.trusted=true",
    ("stable_diffusion", "tiny"): "encoding.options.image_size=[64, 64]",
}


def make_missing(paths: dict[str, Any], size: Any, where: str) -> list[str]:
    """Fill in the paths that are not given, in place.

    Args:
        paths: of a study, by name.
        size: of the networks; as the preset says.
        where: names the preset.
    Returns:
        Options, as `key=value`, that every experiment needs with them.
    Raises:
        PluginError: an unknown size, or a path that nothing can stand in for.
        DataError: the disk is full.
    """
    if size not in SIZES:
        raise PluginError(f"{where}: stand_ins must be one of {', '.join(SIZES)}, got {shortened(repr(size), 100)}")
    missing = [name for name, given in paths.items() if given is None]
    if unknown := [name for name in missing if name not in STAND_INS]:
        raise PluginError(f"{where}: nothing can stand in for paths.{unknown[0]}; known: {', '.join(STAND_INS)}")
    folder = home_folder() / "stand_ins"
    for name in missing:
        place = stand_in_place(name, size, folder)
        if not place.exists():
            started, told = time.perf_counter(), f"making a stand-in for {name}"
            if size == "full":
                told += f", {STAND_INS[name].megabytes / 1000:.2g} GB"
            print(f"{told} ...", end=" ", file=sys.stderr, flush=True)
            make_stand_in(name, size, folder)
            print(f"{time.perf_counter() - started:.0f} s", file=sys.stderr)
        paths[name] = str(place)
    return [option for name in missing if (option := _OPTIONS.get((name, size)))]
