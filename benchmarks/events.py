"""Events at memory speed: both tables of this folder, decoding and encoding, one after the other.

Peers are timed where they are installed: pip install -c constraints.txt -e '.[bench]'

    python benchmarks/events.py
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def main() -> int:
    """Run `decoding.py` and `encoding.py` as processes of their own; the first failure ends it."""
    for name in ("decoding.py", "encoding.py"):
        print(f"\n== {name}\n", flush=True)
        status = subprocess.run([sys.executable, str(Path(__file__).with_name(name)), *sys.argv[1:]]).returncode
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
