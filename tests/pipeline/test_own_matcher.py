"""A matcher that a user adds to the table takes part wherever methods are named."""

import numpy as np
import pytest

import bimfit
from bimfit.errors import ConfigError


def test_a_matcher_of_ones_own_is_compared(samples, tmp_path, monkeypatch):
    model = samples / "square-butt-ifc4.ifc"
    scan, _ = bimfit.simulate(model, bimfit.Scenario(spacing=0.1), 3)
    bimfit.write_scan(scan, tmp_path / "scan.npz")
    with pytest.raises(ConfigError, match="unknown method mine"):
        bimfit.compare(model, tmp_path / "scan.npz", bimfit.Config(), methods=["mine"])
    asked = []

    def mine(target, slice_, prior, config):
        asked.append(slice_)
        return bimfit.MATCHERS["icp-plane"](target, slice_, prior, config)

    monkeypatch.setitem(bimfit.MATCHERS, "mine", mine)
    compared = bimfit.compare(model, tmp_path / "scan.npz", bimfit.Config(), methods=["overlap", "mine"])
    result = next(one for one in compared.methods if one.method == "mine")
    assert len(asked) >= len(result.errors) >= 8
    assert np.isfinite(result.errors).all()
