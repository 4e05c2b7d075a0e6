"""Hash every artefact of the store again and set damaged ones aside, so that the next run makes them anew.

python flows/verify.py [--home FOLDER|URL]

Of a home in a bucket the cache of this machine is hashed, and then every artefact of the bucket, which is fetched for
that.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tqdm import tqdm

from ctlev_core.provenance import raw_file_digests
from data_contracts.errors import DataError, TableVersionError
from data_contracts.published import StoredArtefact, kept_versions
from flows.cli import script
from tasks.bucket import Bucket, BucketError
from tasks.store import Store


def verify(store: Store) -> tuple[int, int]:
    """Check every artefact; damaged ones are moved, never deleted.

    Artefacts of tables of another version stay: no run of this code looks for them, and what it needs it makes anew.

    Returns:
        How many are damaged, or missing though published; and how many cannot be read or moved.
    """
    store.use()
    artefacts = store.artefacts()
    damaged = outdated = failed = 0
    with tqdm(total=sum(item.size_bytes for item in artefacts), unit="B", unit_scale=True, desc="verify") as progress:
        for item in artefacts:
            try:
                store.check(item.folder)
            except TableVersionError as error:
                outdated += 1
                tqdm.write(f"outdated, made anew when needed: {item.name}: {error}")
            except DataError as error:
                try:
                    place = store.set_aside_damaged(item.folder)
                    damaged += place is not None
                    if place is not None:
                        tqdm.write(f"damaged: {item.name}: {error}\n  now in {place}")
                except OSError as cause:
                    damaged, failed = damaged + 1, failed + 1
                    tqdm.write(f"damaged: {item.name}: {error}")
                    tqdm.write(f"error: {item.name}: is damaged and cannot be set aside: {cause}", file=sys.stderr)
            except OSError as error:
                # Too many open files, a permission: it passes, and says nothing about what is in the artefact.
                failed += 1
                tqdm.write(f"error: {item.name}: cannot be read: {error}", file=sys.stderr)
            progress.update(item.size_bytes)
    counted = f"{len(artefacts)} artefacts, {damaged} of them damaged" + (f", {outdated} outdated" if outdated else "")
    print(counted + ("; run the flow again" if damaged else ""))
    digests_damaged, digests_failed = _check_raw_file_digests(store)
    in_bucket, unread = (0, 0) if store.bucket is None else _check_bucket(store, store.bucket)
    return damaged + digests_damaged + in_bucket + _check_latest(store), failed + digests_failed + unread


def _check_bucket(store: Store, bucket: Bucket) -> tuple[int, int]:
    """Fetch every artefact of a bucket and hash it; damaged ones are set aside there, and sent again from the cache.

    Returns:
        How many are damaged, and how many cannot be fetched.
    """
    artefacts = [item for item in bucket.artefacts() if item.is_finished]
    damaged = failed = 0
    with tqdm(total=sum(item.size_bytes for item in artefacts), unit="B", unit_scale=True, desc="bucket") as progress:
        for item in artefacts:
            name = f"{item.stage}/{item.key}"
            try:
                store.check_in_bucket(bucket, item.stage, item.key)
            except TableVersionError:
                pass
            except (BucketError, OSError) as error:
                failed += 1
                tqdm.write(f"error: {name}: cannot be fetched: {error}", file=sys.stderr)
            except DataError as error:
                damaged += 1
                tqdm.write(f"damaged in {bucket.url}: {name}: {error}")
                tqdm.write(f"  now in {store.set_aside_in_bucket(bucket, item.stage, item.key)}")
            progress.update(item.size_bytes)
    print(f"{len(artefacts)} artefacts in {bucket.url}, {damaged} of them damaged")
    if sent := store.send_unsent():
        print(f"{sent} sent from {store.home}")
    return damaged, failed


def _check_raw_file_digests(store: Store) -> tuple[int, int]:
    """Set a damaged file of remembered digests aside; the next run hashes its raw files again."""
    path = store.home / raw_file_digests.FILE
    try:
        raw_file_digests.read_remembered(path)
        return 0, 0
    except DataError as error:
        print(f"damaged: {error}")
    except OSError as error:
        print(f"error: {path}: cannot be read: {error}", file=sys.stderr)
        return 0, 1
    try:
        print(f"  now in {store.set_aside(path)}; the next run hashes its raw files again")
        return 1, 0
    except OSError as error:
        print(f"error: {path}: is damaged and cannot be set aside: {error}", file=sys.stderr)
        return 1, 1


def _check_latest(store: Store) -> int:
    """How many latest versions of synthetic data refer to something that is not there, or have a damaged record."""
    try:
        latest = kept_versions(store.home, 0)
    except DataError as error:
        print(f"damaged: {error}")
        return 1
    broken = 0
    for version in latest:
        wrong = [(a, found) for a in version.artefacts if (found := _digest_of(store, a)) != a.digest]
        broken += bool(wrong)
        for artefact, digest in wrong:
            how, where = "changed" if digest else "missing", f"{artefact.stage}/{artefact.key}"
            print(f"{how}: {where} of the latest data, {version}; make the next with flows/regenerate.py")
    return broken


def _digest_of(store: Store, artefact: StoredArtefact) -> str:
    """Of what is under the key of a published artefact, here or else in the bucket; empty where nothing is."""
    return store.held_digest(artefact.stage, artefact.key) or ""


def verify_home(home: Path) -> int:
    """Exit status: 0 all is whole, 1 something was damaged or missing, 2 something cannot be checked or set aside."""
    if not home.is_dir():
        print(f"error: {home}: there is no such home folder", file=sys.stderr)
        return 2
    try:
        store = Store(home)
        store.connect(send=False)
        damaged, failed = verify(store)
    except (BucketError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 2 if failed else int(damaged > 0)


if __name__ == "__main__":
    sys.exit(script("verify"))
