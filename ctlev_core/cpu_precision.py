"""Which precision is computed in. Imports nothing heavy.

bfloat16 is asked for because it is fast. A processor without instructions for it, such as those of most laptops,
converts every number: on an Intel Xeon with AVX-512 but without AVX512_BF16 the gradients of a training step of the
bundled base model take 1.12 s in bfloat16 and 0.48 s in float32, sampling 1.7 and 0.9 s. There what is asked for in
bfloat16 is computed in float32, which is no less exact.
"""

from __future__ import annotations

import functools
import logging
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")
_INSTRUCTIONS = frozenset({"avx512_bf16", "amx_bf16", "bf16", "svebf16"})
"""Of x86 and ARM, as Linux calls them."""
_KEYS = ("flags", "Features")

logger = logging.getLogger(__name__)


def computed_in(precision: str, device_type: str) -> str:
    """The precision that is computed in where another is asked for: `float32` for `bfloat16` on some CPUs."""
    if precision != "bfloat16" or device_type != "cpu" or has_bfloat16():
        return precision
    _say()
    return "float32"


@functools.cache
def has_bfloat16() -> bool:
    """Has this processor instructions for bfloat16? True where the system does not say."""
    return names_bfloat16(CPU_INFO.read_text(errors="replace")) if CPU_INFO.is_file() else True


def names_bfloat16(cpu_info: str) -> bool:
    """Whether the text of `/proc/cpuinfo` lists them; True where it lists no instructions at all."""
    for line in cpu_info.splitlines():
        key, _, value = line.partition(":")
        if key.strip() in _KEYS:
            return not _INSTRUCTIONS.isdisjoint(value.split())
    return True


@functools.cache
def _say() -> None:
    logger.info("this processor has no instructions for bfloat16: computed in float32, which is twice as fast here")
