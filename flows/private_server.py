"""The process of a script's private Prefect server: `python private_server.py FD`.

It serves on the socket that the script opened before, so that nothing else can take its port, answers only requests
addressed to this machine, and makes files that only their owner may read.
"""

from __future__ import annotations

import os
import socket
import sys


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
    uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_keep_alive=30)).run(sockets=[listening])


if __name__ == "__main__":
    main()
