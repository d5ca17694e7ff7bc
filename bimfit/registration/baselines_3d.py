"""The usual ways to register a cloud in space, to compare with: ICP, G-ICP, FPFH with RANSAC.

All take the model's surface samples, the scan and a first guess, and give what carries the scan to the
model, shape (4, 4).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.registration.surface_3d import Surface

GATE = 0.06
"""Pairs farther apart are not made, m: the window of the comparison reaches that far."""
ITERATIONS = 100
_FEATURE_CELL = 0.012

Baseline3D = Callable[[Surface, Array, Array], Array]


def icp_plane(surface: Surface, scan: Array, T0: Array) -> Array:
    """Point-to-plane ICP (Open3D)."""
    return _icp(surface, scan, T0, tukey=False)


def icp_plane_tukey(surface: Surface, scan: Array, T0: Array) -> Array:
    """Point-to-plane ICP with Tukey's kernel of 10 mm (Open3D)."""
    return _icp(surface, scan, T0, tukey=True)


def g_icp(surface: Surface, scan: Array, T0: Array) -> Array:
    """Generalized ICP (small_gicp)."""
    import small_gicp

    result = small_gicp.align(
        surface.points,
        scan,
        T0,
        registration_type="GICP",
        downsampling_resolution=0.004,
        max_correspondence_distance=GATE,
        max_iterations=ITERATIONS,
    )
    return np.asarray(result.T_target_source, float)


def fpfh_ransac(surface: Surface, scan: Array, T0: Array) -> Array:
    """FPFH features, RANSAC (seeded), then point-to-plane ICP (Open3D); needs no first guess."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    pipelines: Any = o3d.pipelines.registration
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=5.0 * _FEATURE_CELL, max_nn=100)
    clouds: list[Any] = []
    features: list[Any] = []
    for points in (scan, surface.points):
        cloud = _cloud(points).voxel_down_sample(_FEATURE_CELL)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2.5 * _FEATURE_CELL, max_nn=30))
        cloud.orient_normals_to_align_with_direction(np.array([0.0, 0.0, 1.0]))
        clouds.append(cloud)
        features.append(pipelines.compute_fpfh_feature(cloud, search))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        found = pipelines.registration_ransac_based_on_feature_matching(
            clouds[0],
            clouds[1],
            features[0],
            features[1],
            False,
            1.5 * _FEATURE_CELL,
            pipelines.TransformationEstimationPointToPoint(False),
            3,
            [
                pipelines.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                pipelines.CorrespondenceCheckerBasedOnDistance(1.5 * _FEATURE_CELL),
            ],
            pipelines.RANSACConvergenceCriteria(50_000, 0.999),
        )
    return icp_plane(surface, scan, np.asarray(found.transformation, float))


BASELINES_3D: dict[str, Baseline3D] = {
    "icp-plane": icp_plane,
    "icp-plane-tukey": icp_plane_tukey,
    "g-icp": g_icp,
    "fpfh-ransac-icp": fpfh_ransac,
}


def _icp(surface: Surface, scan: Array, T0: Array, *, tukey: bool) -> Array:
    import open3d as o3d

    pipelines = o3d.pipelines.registration
    model = _cloud(surface.points)
    model.normals = o3d.utility.Vector3dVector(surface.normals)
    if tukey:
        estimation = pipelines.TransformationEstimationPointToPlane(pipelines.TukeyLoss(k=0.010))
    else:
        estimation = pipelines.TransformationEstimationPointToPlane()
    criteria = pipelines.ICPConvergenceCriteria(1e-7, 1e-7, ITERATIONS)
    result = pipelines.registration_icp(_cloud(scan), model, GATE, T0, estimation, criteria)
    return np.asarray(result.transformation, float)


def _cloud(points: Array) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
