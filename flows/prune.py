"""Remove from the store what no run has used for long, and nothing that anything kept was made from.

python flows/prune.py [--keep-days N] [--keep-versions N] [--apply] [--home FOLDER]

Without --apply it only lists what would go.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

from data_contracts.errors import DataError
from tasks.store import KEEP_VERSIONS, Store, Stored, StoreInUseError, home_folder


def _days(text: str) -> float:
    days = float(text)
    if not (math.isfinite(days) and days >= 0):
        raise argparse.ArgumentTypeError(f"must be a number of days, 0 or more, got {text!r}")
    return days


def _count(text: str) -> int:
    count = int(text)
    if count < 0:
        raise argparse.ArgumentTypeError(f"must be a number of versions, 0 or more, got {text!r}")
    return count


def _size(items: list[Stored]) -> str:
    return f"{sum(item.size_bytes for item in items) / 1e6:,.1f} MB"


def main() -> int:
    """Exit status: 0 done, 2 not possible; then nothing was removed, or the message says what was left."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--keep-days", type=_days, default=30.0, metavar="N", help="keep what was used since [30]")
    parser.add_argument(
        "--keep-versions",
        type=_count,
        default=KEEP_VERSIONS,
        metavar="N",
        help=f"keep the newest published versions of each experiment, and always the latest [{KEEP_VERSIONS}]",
    )
    parser.add_argument("--apply", action="store_true", help="remove; without it, list what would be removed")
    parser.add_argument("--home", type=Path, help="folder of all state [CTLEV_HOME or .ctlev]")
    arguments = parser.parse_args()
    home = (arguments.home or home_folder()).absolute()
    try:
        if not home.is_dir():
            raise FileNotFoundError(f"{home}: there is no such home folder")
        store = Store(home)
        leaving, kept = store.unneeded(arguments.keep_days, arguments.keep_versions)
        if arguments.apply:
            leaving = store.prune(arguments.keep_days, arguments.keep_versions)
    except (DataError, StoreInUseError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for item in leaving:
        used = time.strftime("%Y-%m-%d", time.localtime(item.last_used_s))
        print(f"{item.kind:8} {_size([item]):>14}  last used {used}  {item.name}")
    verb = "removed" if arguments.apply else "would be removed; --apply removes them"
    print(f"{len(leaving)} of {len(leaving) + len(kept)} folders, {_size(leaving)} of {_size(leaving + kept)}, {verb}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
