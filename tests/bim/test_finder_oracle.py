"""The finder against brute force: points all over every surface, and what their normals meet first."""

from pathlib import Path

import numpy as np
import pytest
from solids import box, model

from bimfit.bim.model import load_model
from bimfit.pipeline.joint_oracle import agreement, meetings

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = sorted((ROOT / "ifc_samples").glob("*.ifc"))
REAL = ROOT.parent / "shared" / "data" / "ifc"
MODELS = [REAL / f"{name}.ifc" for name in ("XELLA-3e_verdieping", "MULTICOM-banden", "ROOT-kalkzandsteen")]


def test_the_oracle_itself_sees_a_gap_and_what_stands_in_it():
    boards = box((-0.2, 0, 0), (-0.01, 1.0, 0.05)), box((0.01, 0, 0), (0.2, 1.0, 0.05))
    seen = meetings(model(*boards))
    assert list(seen) == [("GUID0", "GUID1")]
    # two faces of 0.05 m2, a point for every 4 cm2
    assert len(seen["GUID0", "GUID1"]) == pytest.approx(250, abs=60)
    sheet = box((-0.001, 0, 0), (0.001, 0.5, 0.05))
    shut = meetings(model(*boards, sheet))
    points = shut["GUID0", "GUID1"]
    assert len(points) == pytest.approx(125, abs=45)
    assert np.ptp(points[:, 1]) < 0.51


@pytest.mark.parametrize("path", SAMPLES, ids=lambda p: p.stem)
def test_samples_precision_and_recall(path):
    found = agreement(load_model(path))
    assert found.listed == found.right >= 1
    assert found.missed == ()


@pytest.mark.parametrize("path", MODELS, ids=lambda p: p.stem)
def test_real_models_precision_and_recall(path):
    if not path.is_file():
        pytest.skip("../shared/data/ifc is not here")
    found = agreement(load_model(path))
    assert found.precision >= 0.95
    assert found.recall >= 0.95, found.missed
