"""A short name for how this machine's mathematics rounds, and the versions that belong in a log."""

from __future__ import annotations

import hashlib
import math
import platform
import struct
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version

_GOLDEN = 2_654_435_769  # 2³² divided by the golden ratio: multiples spread evenly
_POINTS = 1500


def numeric_fingerprint() -> str:
    """Sixteen hexadecimal digits that agree where pow, exp, sin and log agree to the last bit.

    Two machines that disagree replay each other's logs to within one step on the wire, not to the bit.
    """
    results: list[float] = []
    for i in range(1, _POINTS + 1):
        fraction = (i * _GOLDEN % 2**32) / 2**32 + 2.0**-33  # exact, in (0, 1)
        other = (i * i * _GOLDEN % 2**32) / 2**32
        results += (
            math.pow(fraction, 3.0 * other),
            math.pow(10.0 * other + 0.5, fraction - 2.0),
            math.exp(20.0 * other - 10.0),
            math.sin(40.0 * fraction - 20.0),
            math.log(fraction),
        )
    return hashlib.sha256(struct.pack(f"<{len(results)}d", *results)).hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of pneud, Python, the C library and the packages whose results a log depends on.

    What is not installed is left out.
    """
    return {
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "libc": " ".join(platform.libc_ver()).strip() or "unknown",
        "machine": platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        **_installed(),
    }


@cache
def _installed() -> dict[str, str]:
    """The packages' versions, which stay what they are as long as a process does."""
    found = {}
    for package in ("pneud", "numpy", "python-can", "cantools", "mcap", "protobuf", "zstandard", "ruckig"):
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
