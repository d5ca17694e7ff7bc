"""The bench of refusals on scenes small enough for a test."""

from __future__ import annotations

from bimfit.pipeline.bench_refusal import bench_refusal
from bimfit.simulation.scenes import TRUE


def test_a_bevel_is_refused_and_the_joint_itself_is_kept():
    text, data = bench_refusal(1, 31, lambda *_: None, (TRUE, "bevel for square", "empty slice"), 0.04)
    for how in ("clean", "degraded"):
        count = data[TRUE][how]["slices"]
        assert count > 15
        assert data[TRUE][how]["flagged"] <= 1
        assert data["bevel for square"][how]["flagged"] >= count - 1
        assert data["empty slice"][how]["refused"] == count
        assert data["empty slice"][how]["joints_flagged"] == 1
    assert text.count("bevel for square") == 2
