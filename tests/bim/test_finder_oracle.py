"""The finder against brute force: points all over every surface, and what their normals meet first.

The oracle knows nothing of planes, strips or pieces: it casts one ray a point, in one scene of all elements.
"""

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from bimfit.bim.joints import find_joints
from bimfit.bim.model import load_model
from bimfit.config import JointConfig

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = sorted((ROOT / "ifc_samples").glob("*.ifc"))
REAL = ROOT.parent / "shared" / "data" / "ifc"
MODELS = [REAL / f"{name}.ifc" for name in ("XELLA-3e_verdieping", "MULTICOM-banden", "ROOT-kalkzandsteen")]

AREA = 4e-4  # m^2 a point
LEAST_GAP, MAX_GAP = 1.5e-3, 0.06


def meetings(model):
    """Pair of GlobalIds -> points where one looks at the other across 1.5 to 60 mm, within 10 degrees."""
    import open3d as o3d

    rng = np.random.default_rng(11)
    meshes = [element.mesh for element in model.elements]
    triangles = np.concatenate([mesh.triangles for mesh in meshes])
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    triangles = triangles - triangles.mean(axis=(0, 1))
    vector = 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(vector, axis=1)
    normal = vector / np.maximum(area, 1e-300)[:, None]
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    corners = o3d.core.Tensor(triangles.reshape(-1, 3).astype(np.float32))
    scene.add_triangles(
        corners, o3d.core.Tensor(np.arange(3 * len(triangles)).reshape(-1, 3).astype(np.uint32))
    )
    which = np.repeat(np.arange(len(area)), rng.poisson(area / AREA))
    a, b = np.sqrt(rng.random(len(which))), rng.random(len(which))
    weights = np.stack([1.0 - a, a * (1.0 - b), a * b], axis=1)
    points = np.einsum("ni,nij->nj", weights, triangles[which])
    start = points + 2e-4 * normal[which]
    hits = scene.cast_rays(o3d.core.Tensor(np.hstack([start, normal[which]]).astype(np.float32)))
    distance = hits["t_hit"].numpy() + 2e-4
    met = np.where(np.isfinite(distance), hits["primitive_ids"].numpy(), 0)
    facing = np.einsum("ij,ij->i", normal[which], normal[met]) < -np.cos(np.radians(10.0))
    good = facing & (distance > LEAST_GAP) & (distance < MAX_GAP) & (owner[which] != owner[met])
    out = defaultdict(list)
    for i in np.flatnonzero(good):
        pair = tuple(sorted((owner[which[i]], owner[met[i]])))
        out[tuple(model.elements[k].guid for k in pair)].append(points[i])
    return {pair: np.array(found) for pair, found in out.items()}


def extents(points):
    """Sizes along the points' own axes, greatest first."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return np.sort(np.ptp(centred @ axes.T, axis=0))[::-1]


def compare(path):
    model = load_model(path)
    truth = meetings(model)
    found = find_joints(model, JointConfig(everything=True))
    open_ = {
        j.elements for j in found if j.state == "open" and j.width > 2e-3 and j.length * j.depth > 8.0 * AREA
    }
    gaps = {j.elements for j in found if j.state in ("open", "filled")}
    # both faces were sampled; well above the finder's limits, so that neither sampling nor filters decide
    clear = {
        pair
        for pair, points in truth.items()
        if len(points) * AREA / 2.0 > 0.004 and extents(points)[0] > 0.15 and extents(points)[1] > 0.015
    }
    right = sum(len(truth.get(pair, ())) >= 2 for pair in open_)
    return len(open_), right, len(clear), len(clear & gaps), clear - gaps


@pytest.mark.parametrize("path", SAMPLES, ids=lambda p: p.stem)
def test_samples_precision_and_recall(path):
    listed, right, clear, recalled, missed = compare(path)
    assert listed == right
    assert recalled == clear, missed
    assert listed >= 1


@pytest.mark.parametrize("path", MODELS, ids=lambda p: p.stem)
def test_real_models_precision_and_recall(path):
    if not path.is_file():
        pytest.skip("../shared/data/ifc is not here")
    listed, right, clear, recalled, missed = compare(path)
    assert right >= 0.95 * listed
    assert recalled >= 0.95 * clear, sorted(missed)
