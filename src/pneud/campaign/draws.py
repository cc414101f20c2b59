"""What a run draws from its seed: each parameter from a stream of its own, so that none changes another."""

from __future__ import annotations

import hashlib
import math
from bisect import bisect
from collections.abc import Mapping
from itertools import accumulate
from statistics import NormalDist
from typing import Any

LAWS = ("uniform", "loguniform", "normal", "choice")
NOISE_BITS = 31  # of a seed of noise


def share(seed: int, name: str) -> float:
    """A number between 0 and 1, neither of them, evenly spread over seeds and names."""
    digest = hashlib.blake2b(f"{seed} {name}".encode(), digest_size=8).digest()
    return ((int.from_bytes(digest, "little") >> 11) + 0.5) * 2.0**-53


def noise_seed(seed: int) -> int:
    """The seed of the sensors' noise in the run of a seed; those of neighbours have nothing in common."""
    return int(share(seed, "noise") * 2**NOISE_BITS)


def drawn(spread: Mapping[str, Mapping[str, Any]], seed: int) -> dict[str, Any]:
    """The values of one run by their parameters' names.

    Args:
        spread: by name, one of `LAWS` with its numbers, as in a campaign's file.
        seed: of the run.
    """
    return {name: quantile(how, share(seed, name)) for name, how in spread.items()}


def quantile(how: Mapping[str, Any], q: float) -> Any:
    """The value that a share `q` of all draws does not exceed; of a choice, the value at that share.

    Args:
        how: one of `LAWS` with its numbers; a normal one may be cut off to lie `within` two numbers.
        q: between 0 and 1.

    Raises:
        KeyError: it is none of them.
    """
    if bounds := how.get("uniform"):
        low, high = bounds
        return low + q * (high - low)
    if bounds := how.get("loguniform"):
        low, high = bounds
        return low * math.exp(q * math.log(high / low))
    if about := how.get("normal"):
        bell = NormalDist(*about)
        if within := how.get("within"):
            least, most = map(bell.cdf, within)
            low, high = within
            q = least + q * (most - least)
            # behind the last digit of the bell nothing can be told apart
            return low if q <= 0.0 else high if q >= 1.0 else min(max(bell.inv_cdf(q), low), high)
        return bell.inv_cdf(q)
    values = how["choice"]
    weights = list(accumulate(how.get("weights") or [1.0] * len(values)))
    return values[min(bisect(weights, q * weights[-1]), len(values) - 1)]
