"""Remove from the store what no run has used for long, and nothing that anything kept was made from.

python flows/prune.py [--keep-days N] [--keep-versions N] [--apply] [--home FOLDER|URL]

Without --apply it only lists what would go.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from data_contracts.errors import DataError
from flows.cli import script
from tasks.store import Store, Stored, StoreInUseError


def _size(items: list[Stored]) -> str:
    return f"{sum(item.size_bytes for item in items) / 1e6:,.1f} MB"


def prune_home(home: Path, keep_days: float, keep_versions: int, *, apply: bool) -> int:
    """Print what goes, and with `apply` remove it.

    Returns:
        Exit status: 0 done, 2 not possible; then nothing was removed, or the message says what was left.
    """
    try:
        if not home.is_dir():
            raise FileNotFoundError(f"{home}: there is no such home folder")
        store = Store(home)
        store.connect(send=False)
        leaving, kept = store.unneeded(keep_days, keep_versions)
        if apply:
            leaving = store.prune(keep_days, keep_versions)
    except (DataError, StoreInUseError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for item in leaving:
        used = time.strftime("%Y-%m-%d", time.localtime(item.last_used_s))
        print(f"{item.kind:8} {_size([item]):>14}  last used {used}  {item.name}")
    verb = "removed" if apply else "would be removed; --apply removes them"
    print(f"{len(leaving)} of {len(leaving) + len(kept)} folders, {_size(leaving)} of {_size(leaving + kept)}, {verb}")
    return 0


if __name__ == "__main__":
    sys.exit(script("prune"))
