"""The process of a script's private Prefect server: `python private_server.py FD`.

It serves on the socket that the script opened before, so that nothing else can take its port, answers only requests
addressed to this machine, and makes files that only their owner may read. Servers of scripts that start at once in one
home make its database one after the other.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def _database_alone() -> Iterator[None]:
    """In this block no other private server changes the tables of the database, which Prefect does without a lock."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(KeyError, OSError):  # a disk without locks
            folder = Path(os.environ["PREFECT_HOME"])
            folder.mkdir(parents=True, exist_ok=True)
            fcntl.flock(stack.enter_context((folder / "start.lock").open("ab")), fcntl.LOCK_EX)
        yield


def main() -> None:
    """Serve on the socket of a number until the script ends."""
    os.umask(0o077)
    listening = socket.socket(fileno=int(sys.argv[1]))
    import uvicorn
    from prefect.server.api.server import create_app
    from starlette.middleware.trustedhost import TrustedHostMiddleware

    app = create_app()
    # A web page whose name its owner points to 127.0.0.1 sends its own name as the host.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=["127.0.0.1", "localhost"])

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            with _database_alone():
                await super().startup(sockets)

    Server(uvicorn.Config(app, log_level="error", timeout_keep_alive=30)).run(sockets=[listening])


if __name__ == "__main__":
    main()
