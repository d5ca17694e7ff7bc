"""bench_scan(): real scans, their size and the live sensor, in figures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bimfit.pipeline import bench_sensor, bench_size
from bimfit.pipeline.bench_sensor import Figures, Progress

ROWS: tuple[tuple[str, Callable[[int, Progress], Figures]], ...] = (
    ("size", bench_size.size),
    ("latency", bench_sensor.latency),
    ("fuzz", bench_sensor.fuzz),
    ("faults", bench_sensor.faults),
)
"""What is measured, in order: a name for the JSON and a function of the seed and of whom to tell."""


def bench_scan(_joints: int, seed: int, progress: Progress) -> tuple[str, dict[str, Any]]:
    """Every row of :data:`ROWS`: the text to print, and the data by their names."""
    found = {name: measure(seed, progress) for name, measure in ROWS}
    return "\n".join(row.text for row in found.values()), {name: row.data for name, row in found.items()}
