"""The near-optimal set: every pose within delta of the best, in clusters that lie apart."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from bimfit.config import SearchConfig
from bimfit.geometry.pose import Pose2D
from bimfit.registration.grcsm import Problem, pose_of, run
from bimfit.registration.lattice import Integers
from bimfit.registration.result import Mode

MAX_MODES = 16
APART = 3  # lattice steps without a near-optimal pose that part two clusters


def near_optimal(problem: Problem, config: SearchConfig, score: int, prior: Pose2D) -> tuple[Mode, ...]:
    """Rivals of the best pose: the best of every cluster but its own, best first.

    Poses whose score is at least (1 - delta) times the best are collected by the same bounds, and
    joined into clusters where they lie within three lattice steps on every axis. A ridge along a
    direction that the data leave free is thus one cluster, not many.
    """
    floor = math.ceil(score * (1.0 - config.delta)) if score > 0 else score
    quiet = dataclasses.replace(config, eps=0.0, max_evaluations=None)
    codes, scores = run(problem, quiet, collect_from=floor).found
    order = np.lexsort((codes, -scores))
    index = unpack_all(codes[order])
    label = _clusters(index)
    _, first = np.unique(label, return_index=True)
    own = label[0]
    rivals = [int(i) for i in np.sort(first) if label[i] != own][:MAX_MODES]
    return tuple(
        Mode(
            pose_of(
                problem.tables.lattice,
                problem.pivot,
                (int(index[i, 0]), int(index[i, 1]), int(index[i, 2])),
                prior,
            ).as_array(),
            float(scores[order[i]]) * problem.unit,
        )
        for i in rivals
    )


def unpack_all(codes: Integers) -> Integers:
    """Leaf indices (n, 3) in u, v, theta of many codes."""
    mask = (1 << 20) - 1
    return np.stack([codes & mask, (codes >> 20) & mask, codes >> 40], axis=1)


def _clusters(index: Integers) -> Integers:
    """Label of every leaf: joined where within ``APART`` steps on every axis, by coarse cells first."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    coarse, member = np.unique(index // APART, axis=0, return_inverse=True)
    pairs = cKDTree(coarse).query_pairs(1.0, p=np.inf, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(coarse), len(coarse)))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label[member.ravel()], np.int64)
