"""One motion under the beams of all stations, against the station's own likelihood and a dense grid."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import _kernels_beams, _kernels_likelihood
from bimfit.estimation.cells import with_shared_cells
from bimfit.estimation.likelihood import BeamModel, BeamSet, edge_rows
from bimfit.estimation.motion import estimate_joint
from bimfit.estimation.ownership import beam_table
from bimfit.estimation.pooled import Beams, pooled
from bimfit.estimation.posterior import Heard
from bimfit.estimation.station import estimate_station
from bimfit.estimation.trend import Sites, bowed, fit, polynomial
from bimfit.geometry.pose import Pose2D


def _scenario():
    name = "estimation_scenario"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name("scenario.py"))
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return sys.modules[name]


S = _scenario()
SECTIONS = {"square": S.butt(), "groove": S.groove()}


def _estimated(rng, section, motions):
    """Stations of a joint of which A and B move as given, (n, 2, 3) about their corners."""
    stations = []
    for i, pair in enumerate(motions):
        a, b = (Pose2D.about(corner, *x) for corner, x in zip(section.gap.mouth, pair, strict=True))
        slice_ = S.scan(rng, [section.components[0].moved(a), section.components[1].moved(b)], s=0.01 * i)
        stations.append(estimate_station(section, slice_, Pose2D(), SensorConfig(), FitConfig()))
    return stations


def _beams(section, slice_, which):
    """All beams of a slice as one component hears them, and their log-likelihood at a motion of it."""
    beams = BeamSet.of(slice_.beams)
    model = BeamModel.of(SensorConfig())
    table, rows = beam_table(beams, model, 0.012), edge_rows(section.components[which])
    every = table.rows.copy()
    every[_kernels_beams.LIMIT, : len(beams)] = np.where(np.arange(len(beams)) % 9 == 4, 0.27, np.inf)
    table = dataclasses.replace(table, rows=every, spacing=6e-3)
    heard = Heard(rows, table, np.ones(len(beams), bool))
    assert heard.bearing == pytest.approx(3e-4)
    corner = section.gap.mouth[which]

    def likelihood(x):
        pose = Pose2D.about(corner, *x).as_array()
        lines, runs = _kernels_likelihood.scratch(rows, beams.eye)
        return _kernels_likelihood.log_likelihood(
            rows, pose, every, beams.start, beams.eye, table.margin, 3e-4, lines, runs
        )

    moved = [rows - np.r_[corner, corner, 0.0, 0.0], heard.beams, beams.origins - corner[:, None]]
    ends = [np.array([0, len(m)]) for m in (rows, beams.r)]
    packed_up = Beams(
        moved[0], ends[0], moved[1], np.ascontiguousarray(moved[2]), ends[1],
        np.array([table.margin]), np.array([3e-4]),
    )  # fmt: skip
    return packed_up, likelihood


@pytest.mark.parametrize("kind", ["square", "groove"])
@pytest.mark.parametrize("which", [0, 1])
def test_beams_one_by_one_and_in_sum_say_what_a_station_says(kind, which):
    rng = np.random.default_rng(21)
    section = SECTIONS[kind]
    x = np.array([0.002, -0.003, 0.02])
    pose = Pose2D.about(section.gap.mouth[which], *x)
    parts = [c.moved(pose) if k == which else c for k, c in enumerate(section.components)]
    beams, likelihood = _beams(section, S.scan(rng, parts, outliers=0.05, misses=0.05), which)
    tries = x + rng.normal(size=(40, 3)) * (0.004, 0.004, 0.03)
    still, design = np.zeros((1, 3)), np.eye(3)[None]
    ones = beams.likelihood(still, np.ones((1, 1)), tries[:, None, :])
    assert np.allclose(ones, [likelihood(t) for t in tries], atol=2e-3)
    spread = np.diag(np.square([5e-4, 5e-5, 5e-4]))
    Q, q, doubtful = beams.expanded(x[None], design, spread)
    assert 0 < doubtful.beams.shape[1] < 0.3 * beams.beams.shape[1]
    steps = rng.multivariate_normal(np.zeros(3), spread, 40)
    sums = doubtful.likelihood(x[None], np.ones((1, 1)), steps[:, None, :])
    sums += steps @ q - 0.5 * np.einsum("sa,ab,sb->s", steps, Q, steps)
    exact = np.array([likelihood(x + step) for step in steps])
    assert np.abs((sums - sums.mean()) - (exact - exact.mean())).max() < 0.05 + 0.02 * np.ptp(exact)


def _trend(stations, section, which, *, turning=False, moving=False):
    n = len(stations)
    value, precision, step = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n)
    corner = section.gap.mouth[which]
    for i, e in enumerate(stations):
        c = e.components[which]
        arm = c.pose.turn(corner)
        J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
        value[i] = *(c.pose.apply(corner) - corner), c.pose.theta
        precision[i] = np.linalg.inv(J @ c.covariance @ J.T)
        step[i] = c.corner_step
    sites = Sites(np.array([e.s for e in stations]), value, precision, step, np.ones(n))
    basis = polynomial(sites.s, turning=turning, moving=moving)
    return sites, basis, with_shared_cells(sites, basis, fit(sites, basis))


@pytest.mark.parametrize("tilt", [0.03, -0.06])
def test_constant_motion_has_the_posterior_of_a_dense_grid(tilt):
    """Whether B's inner face is seen or not, and its corner in the same box at every station."""
    rng = np.random.default_rng(22)
    section = SECTIONS["square"]
    n = 6
    stations = _estimated(rng, section, np.tile([np.zeros(3), [0.0045, 0.002, tilt]], (n, 1, 1)))
    sites, basis, rough = _trend(stations, section, 1)
    found, borne_out = pooled(stations, [section] * n, 1, sites, basis, rough)
    assert borne_out
    assert np.allclose(found.covariance, found.covariance[0])
    beams = Beams.of(stations, [section] * n, 1, np.ones(n, bool))
    axis = np.linspace(-4.5, 4.5, 25)
    unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = found.value[0] + unit @ np.linalg.cholesky(found.covariance[0]).T
    log = beams.likelihood(np.zeros((n, 3)), np.ones((n, 1)), grid[:, None, :])
    w = np.exp(log - log.max())
    w /= w.sum()
    mean = w @ grid
    sd = np.sqrt(w @ (grid - mean) ** 2)
    assert np.all(np.abs(found.value[0] - mean) < 0.12 * sd)
    assert np.allclose(np.sqrt(np.diag(found.covariance[0])), sd, rtol=0.12)


def test_drifting_corner_is_fixed_by_the_beams_it_crosses():
    """Nearer than by the stations' Gaussians, and honest about it."""
    section = SECTIONS["square"]
    n = 40
    t = np.linspace(-0.5, 0.5, n)[:, None]
    before, after, standard = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(30 + seed)
        ends = rng.uniform(-1.0, 1.0, (2, 2, 3)) * (0.006, 0.004, 0.0)
        motion = ends[0][None] + t[:, :, None] * ends[1][None]
        stations = _estimated(rng, section, motion)
        for which in (0, 1):
            sites, basis, rough = _trend(stations, section, which, moving=True)
            found, _ = pooled(stations, [section] * n, which, sites, basis, rough)
            for trend, errors in ((rough, before), (found, after)):
                errors.append(trend.value[:, 0] - motion[:, which, 0])
            standard.append(after[-1] / np.sqrt(found.covariance[:, 0, 0]))
    assert np.sqrt(np.mean(np.square(after))) < 0.9 * np.sqrt(np.mean(np.square(before)))
    assert 0.6 < np.sqrt(np.mean(np.square(standard))) < 1.4


@pytest.mark.parametrize("size", [0.5e-3, 0.9e-3])
def test_motion_that_beams_contradict_is_not_kept(size):
    """Corners that lie to either side by turns are no straight line to 40 stations."""
    rng = np.random.default_rng(23)
    section = SECTIONS["square"]
    n = 40
    zigzag = np.where(np.arange(n) % 2, size, -size)[:, None, None] * np.array([1.0, 0.4, 0.0])
    stations = _estimated(rng, section, np.tile(zigzag, (1, 2, 1)))
    sites, basis, rough = _trend(stations, section, 0, moving=True)
    assert pooled(stations, [section] * n, 0, sites, basis, rough) == (None, False)
    chosen = estimate_joint(stations, [section] * n, "auto").model
    assert chosen not in ("const", "rigid", "linear")
    assert estimate_joint(stations, [section] * n, "linear").model == "linear"


def test_stations_without_beams_keep_what_their_gaussians_say():
    rng = np.random.default_rng(24)
    section = SECTIONS["square"]
    n = 8
    stations = _estimated(rng, section, np.zeros((n, 2, 3)))
    silent = [
        dataclasses.replace(
            e,
            components=tuple(
                dataclasses.replace(c, posterior=dataclasses.replace(c.posterior, heard=None))
                for c in e.components
            ),
        )
        for e in stations
    ]
    sites, basis, rough = _trend(silent, section, 0)
    assert pooled(silent, [section] * n, 0, sites, basis, rough) == (None, True)
    few = [silent[0], *stations[1:]]
    found, _ = pooled(few, [section] * n, 0, sites, basis, rough)
    every, _ = pooled(stations, [section] * n, 0, sites, basis, rough)
    assert found.covariance[0, 1, 1] > every.covariance[0, 1, 1]


def test_bow_of_what_moves_in_a_turning_joint_is_within_its_prior():
    """R(phi(t)) d(t) with both linear: its quadratic part against the prior that allows for it."""
    rng = np.random.default_rng(25)
    section = SECTIONS["square"]
    s = np.linspace(0.0, 0.8, 41)
    t = np.linspace(-0.5, 0.5, 41)
    scores = []
    for _ in range(200):
        common, own = rng.uniform(-1, 1, (2, 3)), rng.uniform(-1, 1, (2, 2, 3))
        size = np.array([0.02, 0.02, np.radians(5)]), np.array([0.006, 0.006, np.radians(3)])
        values = np.zeros((2, 41, 3))
        for i in range(41):
            joint = Pose2D(*((common[0] + t[i] * common[1]) * size[0]))
            for k, corner in enumerate(section.gap.mouth):
                pose = joint @ Pose2D.about(corner, *((own[0, k] + t[i] * own[1, k]) * size[1]))
                values[k, i] = *(pose.apply(corner) - corner), pose.theta
        precision = np.broadcast_to(np.diag([1e8, 1e8, 1e6]), (41, 3, 3)).copy()
        parts = [Sites(s, v, precision, np.full(41, np.nan), np.ones(41)) for v in values]
        line = polynomial(s, turning=True)
        pair = tuple(fit(p, line) for p in parts)
        basis = bowed(line, pair)
        bow = np.linalg.lstsq(basis.functions, values[0], rcond=None)[0][2, :2]
        scores.append(bow * np.sqrt(basis.penalty[2, 2, :2]))
        rest = values[0] - basis.functions @ np.linalg.lstsq(basis.functions, values[0], rcond=None)[0]
        assert np.abs(rest[:, :2]).max() < 2e-5
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.3
