"""What verify and prune do to a bucket and to the cache of this machine."""

import shutil
import time
from dataclasses import replace

import bucket_server
import pytest
from stored_artefacts import key, publish

from data_contracts.home_folder import home_folder
from flows.prune import prune_home
from flows.verify import verify_home
from tasks import bucket_cache
from tasks import store as store_module
from tasks.bucket import Bucket
from tasks.store import Store

DAY_S = 86_400


@pytest.fixture
def machine(bucket_url, tmp_path, monkeypatch):
    """A store of the bucket on the machine of a name."""

    def store(name):
        monkeypatch.setenv("CTLEV_CACHE", str(tmp_path / name))
        return Store(home_folder(bucket_url))

    return store


def end_of_the_process(store):
    """As if what used the store so far had been in a process that has ended."""
    if store.home in store_module._used:
        store_module._used.pop(store.home).close()
    for file, _ in bucket_cache._notes.values():
        file.close()
    bucket_cache._notes.clear()


def stored(bucket):
    names = [name.split("/") for name in bucket_server.objects(bucket.url)]
    return {int(name[2], 16) for name in names if name[0] == "artefacts" and name[-1] == "run.json"}


def flip(bucket, number, name):
    objects = bucket_server.objects(bucket.url)
    (path,) = [path for path in objects if f"/{key(number)}/" in path and path.endswith(name)]
    content = objects[path]
    bucket_server.write_object(bucket.url, path, content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])


def test_verify_says_what_is_damaged_in_the_bucket_and_sends_what_the_cache_has(machine, capsys):
    first, second = machine("a"), machine("b")
    publish(first, 1)
    publish(first, 2)
    publish(second, 3)
    flip(first.bucket, 1, "frames.npy")
    flip(first.bucket, 3, "weights.bin")
    assert verify_home(first.home) == 1
    said = capsys.readouterr().out
    for number in (1, 3):
        assert f"damaged in {first.bucket.url}: encode/{key(number)}: " in said
    assert "2 artefacts, 0 of them damaged" in said, "of the cache"
    assert f"3 artefacts in {first.bucket.url}, 2 of them damaged" in said and "1 sent from" in said
    assert stored(first.bucket) == {1, 2}, "3 is in the cache of another machine"
    assert second.send_unsent() == 0
    assert verify_home(first.home) == 0
    assert "2 artefacts in" in capsys.readouterr().out


def test_damage_of_the_cache_is_set_aside_and_fetched_again(machine, capsys):
    store = machine("a")
    folder = publish(store, 1)
    whole = (folder / "frames.npy").read_bytes()
    (folder / "frames.npy").write_bytes(bytes(len(whole)))
    assert verify_home(store.home) == 1 and not folder.exists()
    assert store.find("encode", key(1)) is not None and (folder / "frames.npy").read_bytes() == whole


def test_damage_of_the_cache_is_not_sent(machine, capsys):
    store = machine("a")
    folder = publish(store, 1)
    store.bucket.remove("encode", key(1))
    (store.home / "uploaded" / "encode" / key(1)).unlink()
    content = (folder / "frames.npy").read_bytes()
    (folder / "frames.npy").write_bytes(content[:-1] + b"!")
    assert store.send_unsent() == 0 and stored(store.bucket) == set()
    assert f"damaged, and not sent: {folder / 'frames.npy'}" in capsys.readouterr().err
    (folder / "frames.npy").write_bytes(content)
    assert store.send_unsent() == 1 and stored(store.bucket) == {1}


def test_prune_removes_from_bucket_and_cache_what_it_lists(machine, capsys, monkeypatch):
    first, second = machine("a"), machine("b")
    for number, inputs in {1: (), 2: (1,), 3: ()}.items():
        publish(first, number, inputs=inputs)
    publish(second, 4)
    second.find("encode", key(3))
    end_of_the_process(first)
    later = Bucket.clock(first.bucket) + 40 * DAY_S
    monkeypatch.setattr(Bucket, "clock", lambda self: later)
    found = Bucket.artefacts

    def used_in_40_days(bucket):
        """As if another machine used 2 then, which was made from 1."""
        return (replace(one, last_used_s=later) if one.key == key(2) else one for one in found(bucket))

    monkeypatch.setattr(Bucket, "artefacts", used_in_40_days)
    assert prune_home(first.home, 30, 5, apply=False) == 0
    listed = capsys.readouterr().out
    assert f"encode/{key(3)}" in listed and f"encode/{key(4)}" in listed and key(1) not in listed
    assert stored(first.bucket) == {1, 2, 3, 4} and first.folder("encode", key(3)).is_dir()
    assert prune_home(first.home, 30, 5, apply=True) == 0
    assert stored(first.bucket) == {1, 2} and not first.folder("encode", key(3)).exists()
    assert first.folder("encode", key(1)).is_dir()
    assert second.folder("encode", key(3)).is_dir(), "the cache of another machine is its own"
    assert not [name for name in bucket_server.objects(first.bucket.url) if key(3) in name or key(4) in name]


def test_what_was_begun_long_ago_goes_and_what_is_being_sent_stays(machine, monkeypatch, capsys):
    store = machine("a")
    store.home.mkdir(exist_ok=True)
    name = f"artefacts/encode/{key(5)}/{'0' * 64}/frames.npy"
    bucket_server.write_object(store.bucket.url, name, b"half")
    assert prune_home(store.home, 30, 5, apply=True) == 0
    assert name in bucket_server.objects(store.bucket.url)
    end_of_the_process(store)
    now = Bucket.clock(store.bucket)
    monkeypatch.setattr(Bucket, "clock", lambda self: now + 2 * DAY_S)
    assert prune_home(store.home, 30, 5, apply=True) == 0
    assert f"last used {time.strftime('%Y-%m-%d')}  encode/{key(5)}" in capsys.readouterr().out
    assert name not in bucket_server.objects(store.bucket.url)


def test_pruning_waits_for_no_machine_but_refuses_while_this_one_uses_the_cache(machine, capsys):
    store = machine("a")
    publish(store, 1)
    store.find("encode", key(1))
    assert prune_home(store.home, 0, 0, apply=True) == 2
    assert "a run uses this store" in capsys.readouterr().err and stored(store.bucket) == {1}


def test_an_empty_cache_is_enough_to_verify_and_prune(machine, capsys):
    first = machine("a")
    publish(first, 1)
    shutil.rmtree(first.home)
    empty = machine("b")
    assert verify_home(empty.home) == 0 and "1 artefacts in" in capsys.readouterr().out
    end_of_the_process(empty)
    assert prune_home(empty.home, 30, 5, apply=True) == 0
    assert "0 of 1 folders" in capsys.readouterr().out
