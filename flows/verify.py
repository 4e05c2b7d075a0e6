"""Hash every artefact of the store again and set damaged ones aside, so that the next run makes them anew.

python flows/verify.py [--home FOLDER]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from tasks.store import Store, home_folder


def verify(store: Store) -> tuple[int, int]:
    """Check every artefact; damaged ones are moved, never deleted.

    Returns:
        How many are damaged, and how many cannot be read or moved.
    """
    store.use()
    artefacts = store.artefacts()
    damaged = failed = 0
    with tqdm(total=sum(item.size_bytes for item in artefacts), unit="B", unit_scale=True, desc="verify") as progress:
        for item in artefacts:
            try:
                store.check(item.folder)
            except PermissionError as error:
                failed += 1
                tqdm.write(f"error: {item.name}: cannot be read: {error}", file=sys.stderr)
            except (ValueError, OSError) as error:
                damaged += 1
                tqdm.write(f"damaged: {item.name}: {error}")
                try:
                    tqdm.write(f"  now in {store.set_aside(item.folder)}")
                except OSError as cause:
                    failed += 1
                    tqdm.write(f"error: {item.name}: is damaged and cannot be set aside: {cause}", file=sys.stderr)
            progress.update(item.size_bytes)
    print(f"{len(artefacts)} artefacts, {damaged} of them damaged" + ("; run the flow again" if damaged else ""))
    return damaged, failed


def main() -> int:
    """Exit status: 0 all is whole, 1 something was damaged, 2 something could not be checked or set aside."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--home", type=Path, help="folder of all state [CTLEV_HOME or .ctlev]")
    home = (parser.parse_args().home or home_folder()).absolute()
    if not home.is_dir():
        print(f"error: {home}: there is no such home folder", file=sys.stderr)
        return 2
    damaged, failed = verify(Store(home))
    return 2 if failed else int(damaged > 0)


if __name__ == "__main__":
    sys.exit(main())
