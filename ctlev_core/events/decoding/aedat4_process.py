"""The AEDAT 4 decoder in a process of its own, for what some corrupt files do to it ends a process: it panics while it
panics, reads outside of its buffers, or asks for more memory than there is.

Run as a program, this file decodes the streams of one kind of one file (`events`, `frame`, `imus`) and writes to
standard output: 8 bytes of length and that many of JSON {"streams": [...]}, then for each packet its length in bytes
and its content: rows of `EVENT` or `IMU`, or `FRAME_HEAD` and pixels. A packet of no length ends the file; {"error":
...} in the place of the first message, or a length of `FAILED`, is followed by a text.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from typing import IO, Any

EVENT = [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")]
_AXES = [f"{name}_{axis}" for name in ("accelerometer", "gyroscope", "magnetometer") for axis in "xyz"]
IMU = [("t", "<u8"), ("temperature", "<f4"), *((name, "<f4") for name in _AXES)]
FRAME_HEAD = struct.Struct("<QQQHHB")
"""Start and end of the exposure, time stamp, us; width, height, channels."""
FAILED = (1 << 64) - 1
MAX_MEMORY_BYTES = 4 << 30
"""Of the decoding process. Packets of real recordings hold a few thousand events."""
_LENGTH = struct.Struct("<Q")


class DecoderError(Exception):
    """The decoder could not read the file, or its process ended."""


@contextlib.contextmanager
def decoding(path: str, kind: str = "events") -> Iterator[tuple[list[dict[str, Any]], Iterator[bytes]]]:
    """The streams of a kind in a file, and the content of one packet of them after the other.

    Raises:
        DecoderError: here, and where packets are read.
    """
    # One thread each: the decoder uses one, and numpy's own would count against the memory limit.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-P", __file__, path, kind]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
    )
    try:
        assert process.stdout is not None
        first = json.loads(_receive(process, process.stdout) or b"{}")
        yield first.get("streams", []), iter(lambda: _receive(process, process.stdout), b"")
    finally:
        process.kill()
        process.communicate()


def _receive(process: subprocess.Popen[bytes], pipe: IO[bytes] | None) -> bytes:
    assert pipe is not None
    head = pipe.read(_LENGTH.size)
    length = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
    if len(head) == _LENGTH.size and length == FAILED:
        raise DecoderError(pipe.read().decode("utf-8", "replace"))
    content = pipe.read(length) if length else b""
    if len(head) < _LENGTH.size or len(content) < length:
        code = process.wait()
        raise DecoderError(f"its process ended with {signal.Signals(-code).name if code < 0 else f'status {code}'}")
    return content


def _send(content: bytes) -> None:
    sys.stdout.buffer.write(_LENGTH.pack(len(content)))
    sys.stdout.buffer.write(content)


def _content(packet: dict[str, Any], kind: str) -> bytes:
    if kind != "frame":
        return packet[kind].tobytes()
    frame = packet[kind]
    pixels, times = frame["pixels"], [int(frame[name]) for name in ("exposure_begin_t", "exposure_end_t", "t")]
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    return FRAME_HEAD.pack(*times, pixels.shape[1], pixels.shape[0], channels) + pixels.tobytes()


def _serve(path: str, kind: str) -> None:
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = MAX_MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(hard, MAX_MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        import aedat

        decoder = aedat.Decoder(path)
        streams = [stream for stream in decoder.id_to_stream().values() if stream["type"] == kind]
        sizes = [{name: int(stream.get(name, 0)) for name in ("width", "height")} for stream in streams]
        _send(json.dumps({"streams": sizes}).encode())
        while (packet := next(decoder, None)) is not None:
            if kind in packet and len(packet[kind]):
                _send(_content(packet, kind))
        _send(b"")
    except BaseException as error:  # a panic is no Exception
        sys.stdout.buffer.write(_LENGTH.pack(FAILED) + str(error).encode()[:300])
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    _serve(*sys.argv[1:])
