"""Machines share artefacts through a bucket: an S3 server on loopback; a machine is a cache of its own."""

import json
import os
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor

import bucket_server
import pytest
from stored_artefacts import TABLE, key, publish, put_together, record_of

from data_contracts.errors import DataError
from data_contracts.home_folder import home_folder
from tasks import bucket as bucket_module
from tasks import store as store_module
from tasks.bucket import Bucket, BucketError
from tasks.runners import environment_there
from tasks.store import Store


@pytest.fixture
def machine(bucket_url, tmp_path, monkeypatch):
    """A store of the bucket on the machine of a name."""

    def store(name):
        monkeypatch.setenv("CTLEV_CACHE", str(tmp_path / name))
        return Store(home_folder(bucket_url))

    return store


@pytest.fixture
def relay():
    relay = bucket_server.Relay()
    yield relay
    relay.close()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(bucket_module, "RETRY_WAITS_S", (0.01, 0.01))


def through(store, relay, **options):
    """The store, whose bucket is behind a relay."""
    store.bucket = bucket_server.through(relay.endpoint, store.bucket.url, **options)
    return store


def files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def half_made(store):
    return [path for path in (store.home / "tmp").rglob("*") if path.is_file()]


def test_what_one_machine_makes_another_finds_byte_for_byte(machine):
    first, second = machine("a"), machine("b")
    made = publish(first, 1, inputs=(7,))
    assert second.home != first.home
    assert second.held_digest("encode", key(2)) is None and second.find("encode", key(2)) is None
    assert second.held_digest("encode", key(1)) and not (second.home / "artefacts").exists(), "a plan fetches nothing"
    assert second.find("encode", key(1), {key(7): "1" * 64}) is None, "made from other inputs"
    found = second.find("encode", key(1), {key(7): "0" * 64})
    assert found.rows == TABLE.num_rows and found.path.is_relative_to(second.home)
    assert files(found.path) == files(made)


def test_the_record_is_the_last_object_and_is_never_overwritten(machine, monkeypatch):
    order = []
    create, send = Bucket.create, Bucket.send
    monkeypatch.setattr(Bucket, "send", lambda self, path, name: (order.append(name), send(self, path, name)))
    monkeypatch.setattr(Bucket, "create", lambda self, name, content: order.append(name) or create(self, name, content))
    store = machine("a")
    digest = json.loads((publish(store, 1) / "run.json").read_text())["digest"]
    names = [f"{digest}/{name}" for name in ("manifest.parquet", "frames.npy", "checkpoint/weights.bin")]
    assert sorted(order) == sorted(f"artefacts/encode/{key(1)}/{name}" for name in [*names, "run.json"])
    assert order[-1] == f"artefacts/encode/{key(1)}/run.json"
    before = bucket_server.objects(store.bucket.url)
    assert not store.bucket.create(f"artefacts/encode/{key(1)}/run.json", b"{}")
    assert bucket_server.objects(store.bucket.url) == before


def test_an_artefact_of_a_machine_that_was_killed_while_sending_is_none_until_it_is_sent(machine, bucket_url, tmp_path):
    script = """
        import os, signal
        from stored_artefacts import publish
        from tasks import bucket
        from tasks.bucket import Bucket
        from tasks.store import Store

        bucket.MAX_TRANSFERS = 1
        sent, send = [], Bucket.send
        def send_two(self, path, name):
            if len(sent) == 2:
                os.kill(os.getpid(), signal.SIGKILL)
            sent.append(name)
            send(self, path, name)
        Bucket.send = send_two
        publish(Store(), 1)
    """
    environment = os.environ | {"CTLEV_HOME": bucket_url, "CTLEV_CACHE": str(tmp_path / "a")}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    ended = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], env=environment, capture_output=True, text=True
    )
    assert ended.returncode == -9, ended.stderr
    killed, other = machine("a"), machine("b")
    names = bucket_server.objects(bucket_url)
    assert len([name for name in names if name.startswith("artefacts/")]) == 2
    assert other.held_digest("encode", key(1)) is None and other.find("encode", key(1)) is None
    assert killed.find("encode", key(1)) is not None, "what was computed is kept"
    assert killed.send_unsent() == 1 and killed.send_unsent() == 0
    assert files(other.find("encode", key(1)).path) == files(killed.folder("encode", key(1)))


def test_cut_answers_are_asked_for_again(machine, relay, impatient):
    made = publish(machine("a"), 1, values=100_000)
    other = through(machine("b"), relay)
    relay.cut_after, relay.cuts = 200_000, 2
    assert files(other.find("encode", key(1)).path) == files(made)
    assert relay.cuts == 0


def test_an_artefact_that_cannot_be_fetched_whole_is_an_error_and_no_artefact(machine, relay, impatient):
    publish(machine("a"), 1, values=100_000)
    other = through(machine("b"), relay, config_kwargs={"retries": {"max_attempts": 1}})
    other.bucket._files[0].retries = 1
    relay.cut_after, relay.cuts = 200_000, 10**6
    with pytest.raises(BucketError, match=r"s3://events-.*could not be read: .*run again"):
        other.find("encode", key(1))
    assert not other.folder("encode", key(1)).exists() and half_made(other) == []
    relay.cuts = 0
    assert other.find("encode", key(1)) is not None


DAMAGES = [
    (damage, name)
    for damage in ("bit", "cut", "gone")
    for name in ("frames.npy", "checkpoint/weights.bin", "manifest.parquet", "run.json")
    if (damage, name) != ("gone", "run.json")  # without its record it is no artefact
]


@pytest.mark.parametrize(("damage", "name"), DAMAGES)
def test_damage_in_the_bucket_never_becomes_an_artefact(machine, capsys, name, damage):
    maker, other = machine("a"), machine("b")
    publish(maker, 1)
    objects = bucket_server.objects(maker.bucket.url)
    (path,) = [path for path in objects if path.endswith(name)]
    content = objects[path]
    if damage == "gone":
        maker.bucket.delete(path)
    else:
        changed = content[:-5] if damage == "cut" else content[:-9] + bytes([content[-9] ^ 1]) + content[-8:]
        bucket_server.write_object(maker.bucket.url, path, changed)
    assert other.find("encode", key(1)) is None
    assert not other.folder("encode", key(1)).exists() and half_made(other) == []
    assert path not in (damaged := bucket_server.objects(maker.bucket.url)) or damaged[path] != content
    assert not [name for name in damaged if name.startswith("damaged/")], "who does not hold the lock moves nothing"
    with other.lock(key(1)):
        assert other.find("encode", key(1), make_room=True) is None
        said = capsys.readouterr().err
        assert f"damaged in {maker.bucket.url}: encode/{key(1)}: " in said and f"damaged/encode/{key(1)}." in said
        publish(other, 1)
    third = machine("c").find("encode", key(1))
    assert files(third.path) == files(other.folder("encode", key(1)))


def test_names_that_lead_out_of_the_artefact_are_refused(machine, monkeypatch, tmp_path):
    store = machine("a")
    publish(store, 1)
    monkeypatch.setattr(Bucket, "list", lambda self, folder: {"../../evil": {"size": 1}})
    with pytest.raises(DataError, match=r"'\.\./\.\./evil', which leads out of the artefact"):
        store.bucket.download("encode", key(1), "0" * 64, tmp_path / "x" / "y" / key(1))
    assert not list(tmp_path.rglob("evil"))


def test_an_artefact_of_other_inputs_makes_room_for_the_new_one(machine):
    first, second = machine("a"), machine("b")
    publish(first, 1, inputs=(7,))
    with second.lock(key(1)):
        assert second.find("encode", key(1), {key(8): "0" * 64}, make_room=True) is None
        publish(second, 1, inputs=(8,))
    assert machine("c").find("encode", key(1), {key(8): "0" * 64}) is not None
    assert [name for name in bucket_server.objects(first.bucket.url) if name.startswith("damaged/encode/")]


def test_two_machines_that_want_one_artefact_compute_it_once(machine, monkeypatch, capsys):
    monkeypatch.setattr(bucket_module, "POLL_S", 0.05)
    monkeypatch.setattr(bucket_module, "SAY_AFTER_S", 0.1)
    stores, computed = [machine(name) for name in "abcd"], []

    def want(store):
        with store.lock(key(1), "artefact encode/1"):
            found = store.find("encode", key(1), make_room=True)
            if found is None:
                computed.append(store)
                time.sleep(0.5)
                found = store.publish("encode", key(1), put_together(store, 1), record_of(1))
            return found

    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(want, stores))
    assert len(computed) == 1 and len({ref.digest for ref in found}) == 1
    said = capsys.readouterr().err
    assert f"waiting for artefact encode/1: process {os.getpid()} on " in said and f"leases/{key(1)}" in said
    assert not [name for name in bucket_server.objects(stores[0].bucket.url) if name.startswith("leases/")]


def test_who_comes_second_without_knowing_keeps_the_first_ones(machine):
    first, second = machine("a"), machine("b")
    made = publish(first, 1, content=3)
    # As if its lease had been lost: the second made it meanwhile, on a machine that rounds otherwise.
    ref = second.publish("encode", key(1), put_together(second, 1, content=4), record_of(1))
    assert files(ref.path) == files(made)
    assert len(list((second.home / "damaged" / "encode").iterdir())) == 1, "its own is set aside, not deleted"
    names = [name for name in bucket_server.objects(first.bucket.url) if name.startswith("artefacts/")]
    assert len(names) == 4, "nothing of the second is left among the first one's files"


def test_a_lease_is_renewed_while_it_is_held_and_taken_over_when_it_is_not(bucket_url, monkeypatch, capsys):
    monkeypatch.setattr(bucket_module, "LEASE_S", 3.0)
    monkeypatch.setattr(bucket_module, "RENEW_S", 0.3)
    monkeypatch.setattr(bucket_module, "POLL_S", 0.1)
    monkeypatch.setattr(bucket_module, "SAY_AFTER_S", 0.2)
    holder, other = Bucket(bucket_url), Bucket(bucket_url)
    # Clocks of machines may be wrong by a day: the server's decides.
    monkeypatch.setattr(time, "time", lambda: 86_400.0)
    with holder.lease("k", "artefact x/k"):
        ends = time.monotonic() + 5
        while time.monotonic() < ends:
            with (
                pytest.raises(BlockingIOError, match=r"leases/k: process \d+ on \S+ is making artefact x/k"),
                other.lease("k", "artefact x/k", wait=False),
            ):
                pass
            time.sleep(0.2)
    with other.lease("k", "artefact x/k", wait=False):
        pass
    assert other.list("leases/k") == {}
    bucket_server.write_object(bucket_url, "leases/k/000004", b"process 1 on dead, 0\n")
    started = time.monotonic()
    with other.lease("k", "artefact x/k"):
        assert 1.5 < time.monotonic() - started < 8, "the server tells whole seconds"
        assert list(other.list("leases/k")) == ["000004", "000005"]
    assert other.list("leases/k") == {}
    assert "waiting for artefact x/k: process 1 on dead holds" in capsys.readouterr().err


def test_of_conditional_writes_side_by_side_one_succeeds(bucket_url):
    won = []

    def take(number):
        bucket = Bucket(bucket_url)
        created = bucket.create("leases/k/000002", f"{number}\n".encode())
        won.extend([number] if created else [])

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(take, range(16)))
    assert len(won) == 1


def test_a_lost_answer_to_a_conditional_write_is_no_refusal(bucket_url, relay, impatient):
    bucket = bucket_server.through(relay.endpoint, bucket_url)
    bucket.overwrite("warm", b"")
    relay.cut_after, relay.cuts = 0, 2
    assert bucket.create("artefacts/s/k/run.json", b"mine")
    assert relay.cuts == 0 and not bucket.create("artefacts/s/k/run.json", b"another's")
    assert bucket_server.objects(bucket_url)["artefacts/s/k/run.json"] == b"mine"


def full(part):
    """The answer of MinIO whose disk is full to whoever sends an artefact."""
    if not (part.startswith(b"PUT") and b"/artefacts/" in part.split(b"\r\n")[0]):
        return b""
    body = b"<Error><Code>XMinioStorageFull</Code><Message>Storage backend has reached its limit</Message></Error>"
    head = b"HTTP/1.1 507 Insufficient Storage\r\nContent-Type: application/xml\r\nConnection: close\r\n"
    return head + b"Content-Length: %d\r\n\r\n" % len(body) + body


def test_a_full_bucket_is_a_named_error_and_the_next_run_sends_what_was_made(machine, relay, impatient):
    store = through(machine("a"), relay, config_kwargs={"retries": {"max_attempts": 1}})
    relay.answer = full
    with pytest.raises(BucketError) as failed:
        publish(store, 1)
    message = str(failed.value)
    assert message.startswith(f"{store.bucket.url}: an object could not be written: ")
    assert "(XMinioStorageFull)" in message and "Storage backend has reached its limit" in message
    assert f"encode/{key(1)} is kept in {store.home}, and the next run sends it" in message
    assert store.find("encode", key(1)) is not None and machine("b").held_digest("encode", key(1)) is None
    again = machine("a")
    again.connect(send=True)
    assert machine("b").find("encode", key(1)) is not None


def test_a_bucket_that_is_not_there(s3_server):
    with pytest.raises(BucketError, match=r"s3://no-such-bucket/x: there is no such bucket; make it, or"):
        Bucket("s3://no-such-bucket/x").check()


def test_credentials_that_are_not_there(bucket_url, s3_server, monkeypatch):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    with pytest.raises(BucketError, match=r"no credentials were found; for S3 set AWS_ACCESS_KEY_ID and"):
        bucket_server.through(s3_server, bucket_url).check()


def test_a_server_that_is_not_there(bucket_url, relay, impatient):
    relay.close()
    bucket = bucket_server.through(relay.endpoint, bucket_url, config_kwargs={"retries": {"max_attempts": 1}})
    with pytest.raises(BucketError, match=r"could not be written: Could not connect to the endpoint URL.*be reached"):
        bucket.check()


def test_credentials_that_may_only_read(bucket_url, s3_server):
    boto3 = pytest.importorskip("boto3")
    iam = boto3.client("iam")
    user = f"reader-{bucket_url.split('/')[2]}"
    iam.create_user(UserName=user)
    policy = {
        "Version": "2012-10-17",
        "Statement": [{"Effect": "Allow", "Action": ["s3:Get*", "s3:List*"], "Resource": "*"}],
    }
    iam.put_user_policy(UserName=user, PolicyName="read", PolicyDocument=json.dumps(policy))
    access = iam.create_access_key(UserName=user)["AccessKey"]
    bucket = bucket_server.through(s3_server, bucket_url, key=access["AccessKeyId"], secret=access["SecretAccessKey"])
    with bucket_server.enforced_rights(s3_server), pytest.raises(BucketError) as failed:
        bucket.check()
    assert f"{bucket_url}: an object may not be written: " in str(failed.value)
    assert "the credentials need the rights to list, read, write and delete objects" in str(failed.value)


def test_a_server_that_ignores_conditions_is_refused(bucket_url, relay):
    relay.change = lambda part: part.replace(b"If-None-Match: *", b"X-None-Sense-: *")
    with pytest.raises(BucketError, match=r"ignores the condition of a write \(If-None-Match: \*\)"):
        bucket_server.through(relay.endpoint, bucket_url).check()


def test_the_probe_leaves_nothing(bucket_url):
    Bucket(bucket_url).check()
    assert bucket_server.objects(bucket_url) == {}


def test_a_package_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(BucketError, match=r"gs://b/p: needs the package gcsfs: pip install gcsfs"):
        Bucket("gs://b/p").check()


def test_a_full_disk_is_not_taken_for_the_buckets_fault(machine, monkeypatch):
    publish(machine("a"), 1)
    other = machine("b")

    def fill(self, name, path):
        return self._try("read", no_room, str(path))

    def no_room(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Bucket, "fetch", fill)
    with pytest.raises(OSError, match="No space left on device"):
        other.find("encode", key(1))


def test_inputs_that_left_the_cache_are_fetched_where_a_stage_opens_them(machine):
    first, second = machine("a"), machine("b")
    ref = first.find("encode", publish(first, 1).name)
    there = second.here(ref)
    assert there.path == second.folder("encode", key(1)) and files(there.path) == files(ref.path)
    assert there.digest == ref.digest and second.here(there) == there
    gone = ref.model_copy(update={"key": key(2), "path": first.folder("encode", key(2))})
    with pytest.raises(DataError, match=rf"has no artefact encode/{key(2)} any more"):
        second.here(gone)


def test_processes_elsewhere_are_told_of_the_bucket_not_of_our_cache(machine, bucket_url, monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(machine("a").home))
    assert environment_there()["CTLEV_HOME"] == bucket_url
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path / "home"))
    assert environment_there()["CTLEV_HOME"] == str(tmp_path / "home")


def test_a_home_folder_asks_no_bucket(tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "fetch_files", None)
    store = Store(tmp_path)
    publish(store, 1)
    assert store.bucket is None and store.find("encode", key(1)) is not None
    store.connect(send=True)
    store.send_files()
    assert not {"in_use", "uploaded", "shared_files.json"} & {path.name for path in tmp_path.iterdir()}


def test_an_artefact_that_another_machine_removes_while_it_is_fetched_is_not_there(machine, monkeypatch):
    first, second = machine("a"), machine("b")
    publish(first, 1)
    listed = Bucket.list

    def list_and_lose(self, folder):
        found = listed(self, folder)
        if folder.startswith("artefacts/encode/"):
            monkeypatch.setattr(Bucket, "list", listed)
            first.bucket.remove("encode", key(1))
        return found

    monkeypatch.setattr(Bucket, "list", list_and_lose)
    assert second.find("encode", key(1)) is None and not half_made(second)
    publish(second, 1)
    monkeypatch.setattr(Bucket, "list", list_and_lose)
    second.check_in_bucket(second.bucket, "encode", key(1))
