"""An S3 server on loopback (moto), and a relay before it that cuts connections, changes requests or answers itself."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import fsspec

from tasks.bucket import Bucket

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "key",
    "AWS_SECRET_ACCESS_KEY": "secret",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
    "AWS_CONFIG_FILE": "/nowhere",
    "AWS_SHARED_CREDENTIALS_FILE": "/nowhere",
}


@contextlib.contextmanager
def s3_server() -> Iterator[str]:
    """The URL of a server without any bucket."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        yield f"http://{host}:{port}"
    finally:
        server.stop()


def new_bucket() -> str:
    """The URL of a home in a bucket of its own."""
    name = f"events-{uuid.uuid4().hex[:12]}"
    fsspec.filesystem("s3", use_listings_cache=False).mkdir(name)
    return f"s3://{name}/home"


def objects(url: str) -> dict[str, bytes]:
    """Every object below a URL, by its name below it."""
    files, root = fsspec.url_to_fs(url, use_listings_cache=False)
    return {path.removeprefix(f"{root}/"): files.cat_file(path) for path in files.find(root)}


def write_object(url: str, name: str, content: bytes) -> None:
    """Write an object below a URL."""
    files, root = fsspec.url_to_fs(url, use_listings_cache=False)
    files.pipe_file(f"{root}/{name}", content)


def through(endpoint: str, url: str, **options: Any) -> Bucket:
    """A home in a bucket that is reached by another address, with connections of its own."""
    bucket = Bucket(url)
    found = fsspec.url_to_fs(url, endpoint_url=endpoint, use_listings_cache=False, skip_instance_cache=True, **options)
    bucket.__dict__["_files"] = found
    return bucket


class Relay:
    """Sends on what comes, both ways, to the server that AWS_ENDPOINT_URL names.

    Attributes:
        cut_after: bytes of answers after which a connection is cut.
        cuts: how many connections are cut so.
        change: of each part of a request, before it is sent on.
        answer: of the first bytes of a request, an answer in the place of the server's; empty = the server's.
    """

    def __init__(self) -> None:
        self.cut_after = 0
        self.cuts = 0
        self.change: Callable[[bytes], bytes] = lambda part: part
        self.answer: Callable[[bytes], bytes] = lambda part: b""
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listening.close()

    def _accept(self) -> None:
        host, port = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://").split(":")
        with contextlib.suppress(OSError):
            while True:
                client = self._listening.accept()[0]
                server = socket.create_connection((host, int(port)))
                threading.Thread(target=self._requests, args=(client, server), daemon=True).start()
                threading.Thread(target=self._answers, args=(client, server), daemon=True).start()

    def _requests(self, client: socket.socket, server: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while part := client.recv(65536):
                if answer := self.answer(part):
                    client.sendall(answer)
                    break
                server.sendall(self.change(part))
        _close(client, server)

    def _answers(self, client: socket.socket, server: socket.socket) -> None:
        sent = 0
        with contextlib.suppress(OSError):
            while part := server.recv(4096):
                if self.cuts > 0 and sent + len(part) > self.cut_after:
                    self.cuts -= 1
                    client.sendall(part[: max(self.cut_after - sent, 0)])
                    break
                client.sendall(part)
                sent += len(part)
        _close(client, server)


def _close(*ends: socket.socket) -> None:
    for end in ends:
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
        end.close()


@contextlib.contextmanager
def enforced_rights(endpoint: str) -> Iterator[None]:
    """Inside this block the server checks the policies of its users (moto does not by default)."""
    _set_unchecked(endpoint, 0)
    try:
        yield
    finally:
        _set_unchecked(endpoint, 10**9)


def _set_unchecked(endpoint: str, requests: int) -> None:
    plain = {"Content-Type": "text/plain"}
    asked = urllib.request.Request(f"{endpoint}/moto-api/reset-auth", data=str(requests).encode(), headers=plain)
    with urllib.request.urlopen(asked) as answer:
        assert answer.status == 200


def remove_bucket(url: str) -> None:
    """Remove the bucket of a home with all that is in it."""
    fsspec.filesystem("s3", use_listings_cache=False).rm(url.split("/")[2], recursive=True)
