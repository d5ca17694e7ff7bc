"""What a Hokuyo rangefinder sends instead of a range: codes below 20, each with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

FIRST_MEASUREMENT = 20
"""Values below are codes, not millimetres."""

REASONS: Mapping[int, str] = MappingProxyType(
    {
        0: "nothing in range (possibly 22 m)",
        1: "low intensity",
        2: "low intensity",
        6: "measurement failed",
        7: "neighbouring steps failed",
        8: "intensities do not match",
        9: "same step failed twice",
        18: "strong reflector",
        19: "not measurable",
    }
)


def reason(code: int) -> str:
    """Why a value below 20 is not a measurement."""
    if code < 0 or code >= FIRST_MEASUREMENT:
        raise ValueError(f"{code} is no error code")
    return REASONS.get(code, "measurement failed")


def counted_reasons(codes: ArrayLike) -> str:
    """How many of the values (n,) have which reason, such as ``12 low intensity, 3 not measurable``."""
    values = np.asarray(codes, np.int64)
    numbers, counts = np.unique(values[(values >= 0) & (values < FIRST_MEASUREMENT)], return_counts=True)
    found: dict[str, int] = {}
    for code, count in zip(numbers.tolist(), counts.tolist(), strict=True):
        found[reason(code)] = found.get(reason(code), 0) + count
    return ", ".join(f"{count:,} {why}" for why, count in sorted(found.items(), key=lambda item: -item[1]))
