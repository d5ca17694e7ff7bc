"""Motion along the joint: right model, right accuracy, outliers found, gaps bridged honestly."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bimfit.config import SensorConfig
from bimfit.errors import ConfigError
from bimfit.estimation import _kernels_knots as kernels
from bimfit.estimation.cells import cell_correlation
from bimfit.estimation.motion import estimate_joint
from bimfit.estimation.result import ComponentEstimate, StationEstimate
from bimfit.estimation.trend import (
    NODES,
    Basis,
    Evidence,
    Sites,
    bends,
    fit,
    hats,
    polynomial,
    smooth,
    solve,
)
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.status import OK, Status

FRAME = SectionFrame.from_axes((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
CORNERS = (np.array([-0.0125, 0.0]), np.array([0.0125, 0.0]))
SD = np.array([0.4e-3, 0.4e-3, 8e-3])
N = 83


def _sections():
    a = Profile.polygon([(-0.2125, -0.025), (-0.0125, -0.025), (-0.0125, 0.0), (-0.2125, 0.0)])
    b = Profile.polygon([(0.0125, -0.025), (0.2125, -0.025), (0.2125, 0.0), (0.0125, 0.0)])
    gap = GapOutline(np.array([CORNERS[0], (-0.0125, -0.025)]), np.array([CORNERS[1], (0.0125, -0.025)]))
    return [JointSection(0.01 * i, FRAME, (a, b), gap) for i in range(N)]


def _stations(rng, truth):
    """Independent Gaussian estimates about a truth (2, N, 3) of corner motions."""
    out = []
    for i in range(N):
        components = []
        for k in (0, 1):
            pose = Pose2D.about(CORNERS[k], *(truth[k, i] + rng.normal(0.0, SD)))
            arm = pose.turn(CORNERS[k])
            J = np.linalg.inv(np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]]))
            components.append(ComponentEstimate(pose, J @ np.diag(SD**2) @ J.T, OK))
        out.append(StationEstimate(0.01 * i, Pose2D(), tuple(components), OK, SensorConfig()))
    return out


def _truth(kind, rng):
    t = np.linspace(0.0, 1.0, N)[None, :, None]
    a = rng.uniform(-1, 1, (2, 1, 3)) * (6e-3, 6e-3, 0.05)
    b = rng.uniform(-1, 1, (2, 1, 3)) * (6e-3, 6e-3, 0.05)
    if kind == "const":
        return np.repeat(a, N, axis=1)
    if kind == "linear":
        return a + (b - a) * t
    if kind == "rigid":
        return a + (b - a) * t * np.array([1.0, 1.0, 0.0])
    if kind == "smooth":
        return a + 5e-3 * np.sin(np.pi * t) * np.array([1.0, 1.0, 4.0])
    at = np.sort(np.r_[0, N - 1, rng.choice(np.arange(5, N - 5, 8), 6, replace=False)])
    values = rng.uniform(-1, 1, (2, len(at), 3)) * (20e-3, 20e-3, 0.12)
    return np.stack(
        [[np.interp(np.arange(N), at, values[k, :, c]) for c in range(3)] for k in (0, 1)]
    ).transpose(0, 2, 1)


def _errors(result, truth):
    return np.array(
        [
            [
                np.array([*(c.pose.apply(CORNERS[k]) - CORNERS[k]), c.pose.theta]) - truth[k, i]
                for i, c in enumerate(e.components[k] for e in result.stations)
            ]
            for k in (0, 1)
        ]
    )


@pytest.mark.parametrize("kind", ["const", "rigid", "linear", "smooth", "kinked"])
def test_auto_chooses_the_model_that_made_the_joint_and_gains_by_it(kind):
    rng = np.random.default_rng(3)
    truth = _truth(kind, rng)
    stations = _stations(rng, truth)
    result = estimate_joint(stations, _sections(), "auto")
    assert result.model == kind
    gain = {"const": 5.0, "rigid": 3.5, "linear": 3.5, "smooth": 1.8, "kinked": 1.6}[kind]
    rms = np.sqrt(np.mean(_errors(result, truth) ** 2, axis=(0, 1)))
    assert np.all(rms < SD / gain)
    # standard deviations that say so
    variance = np.mean([np.diag(c.covariance)[2] for e in result.stations for c in e.components])
    assert 0.5 < rms[2] / np.sqrt(variance) < 1.6


def test_a_jump_is_flagged_and_does_not_pull_its_neighbours():
    rng = np.random.default_rng(5)
    truth = _truth("linear", rng)
    moved = truth.copy()
    moved[0, 40, 0] += 4e-3
    result = estimate_joint(_stations(rng, moved), _sections(), "linear")
    assert (40, "A") in result.outliers
    assert len(result.outliers) <= 2
    assert result.stations[40].status.name == "ambiguous"
    assert "neighbours" in result.stations[40].status.reason
    error = np.abs(_errors(result, truth)[0, :, 0])
    assert np.delete(error, 40).max() < 0.5e-3
    assert error[40] > 2e-3  # what was measured well stands, even where no neighbour has it


def test_a_far_place_that_no_gap_bears_out_is_refused():
    """A station may land anywhere along a flat face: far from the joint, with no gap in sight, it is none."""
    rng = np.random.default_rng(5)
    truth = _truth("linear", rng)
    truth[0, 40, 0] += 40e-3
    stations = _stations(rng, truth)
    unseen = Status("weak", "no beam passes between the components")
    stations[40] = dataclasses.replace(stations[40], status=unseen)
    near = dataclasses.replace(stations[20], status=unseen)
    stations[20] = near
    result = estimate_joint(stations, _sections(), "auto")
    assert result.stations[40].status.name == "rejected"
    assert (
        "neighbours" in result.stations[40].status.reason and "no beam" in result.stations[40].status.reason
    )
    assert result.stations[20].status == unseen


def test_where_most_stations_are_weak_each_stays_as_it_is():
    rng = np.random.default_rng(6)
    stations = [
        dataclasses.replace(e, status=Status("weak", "no beam passes")) if i % 3 else e
        for i, e in enumerate(_stations(rng, _truth("linear", rng)))
    ]
    assert estimate_joint(stations, _sections(), "auto").model == "independent"
    assert estimate_joint(stations, _sections(), "linear").model == "linear"


@pytest.mark.parametrize(("returns", "model"), [(60, "linear"), (10, "independent")])
def test_doubt_about_a_shape_alone_leaves_the_motion_a_model(returns, model):
    rng = np.random.default_rng(6)
    doubt = Status("weak", "its surface is bent")
    stations = [
        dataclasses.replace(
            e,
            status=doubt,
            through=14,
            components=(
                dataclasses.replace(e.components[0], status=doubt, n_inliers=returns),
                e.components[1],
            ),
        )
        for e in _stations(rng, _truth("linear", rng))
    ]
    result = estimate_joint(stations, _sections(), "auto")
    assert result.model == model
    assert all(e.status == doubt for e in result.stations)


def test_a_station_off_by_what_chance_explains_is_flagged_but_follows_the_joint():
    rng = np.random.default_rng(5)
    truth = _truth("linear", rng)
    moved = truth.copy()
    stations = _stations(rng, moved)
    off = np.array([0.0, 4.4 * SD[1], 0.0])
    arm = Pose2D.about(CORNERS[0], *(truth[0, 40] + off))
    a = dataclasses.replace(stations[40].components[0], pose=arm)
    stations[40] = dataclasses.replace(stations[40], components=(a, stations[40].components[1]))
    result = estimate_joint(stations, _sections(), "linear")
    assert (40, "A") in result.outliers
    assert result.stations[40].status.name == "ambiguous"
    # 4.4 deviations are a jump in a hundred joints at most: half way would be a compromise with chance
    assert abs(_errors(result, truth)[0, 40, 1]) < 0.4 * off[1]


def test_the_component_that_is_measured_follows_the_joint_where_the_other_is_lost():
    rng = np.random.default_rng(6)
    truth = _truth("linear", rng)
    stations = _stations(rng, truth)
    for i in (20, 30, 50, 60):
        _lose(stations, i, which=(0,))
    result = estimate_joint(stations, _sections(), "linear")
    assert {result.stations[i].status.name for i in (20, 30, 50, 60)} == {"weak"}
    alone = _errors(dataclasses.replace(result, stations=tuple(stations[:20])), truth[:, :20])
    assert np.abs(_errors(result, truth)[:, [20, 30, 50, 60], :2]).max() < 0.5 * np.abs(alone[..., :2]).max()


LOST = Status("rejected", "only 3 returns lie on the component")


def _lose(stations, i, which=(0, 1)):
    components = tuple(
        ComponentEstimate(status=LOST) if k in which else c for k, c in enumerate(stations[i].components)
    )
    stations[i] = dataclasses.replace(stations[i], components=components, status=LOST)


def test_a_lost_station_is_taken_from_its_neighbours_and_says_so():
    rng = np.random.default_rng(6)
    truth = _truth("linear", rng)
    stations = [dataclasses.replace(e, combined=None) for e in _stations(rng, truth)]
    for i in (10, 40, 41, N - 1):
        _lose(stations, i)
    result = estimate_joint(stations, _sections(), "auto")
    for i in (10, 40, 41, N - 1):
        station = result.stations[i]
        assert station.status.name == "weak"
        assert "neighbours" in station.status.reason and "only 3 returns" in station.status.reason
    assert np.abs(_errors(result, truth)[:, :, :2]).max() < 0.6e-3


def test_what_is_too_far_from_its_neighbours_or_contradicts_them_stays_lost():
    rng = np.random.default_rng(6)
    truth = _truth("const", rng)
    stations = _stations(rng, truth)
    true = Pose2D(*(truth[:, 0].mean(axis=0) * (1.0, 1.0, 0.0)))
    stations = [dataclasses.replace(e, combined=true) for e in stations]
    for i in (*range(20, 27), 50, 60, N - 2, N - 1):
        _lose(stations, i)
    stations[60] = dataclasses.replace(stations[60], combined=true @ Pose2D(u=0.012))
    result = estimate_joint(stations, _sections(), "auto")
    names = [result.stations[i].status.name for i in (23, 50, 60, N - 2, N - 1)]
    assert names == ["rejected", "weak", "rejected", "weak", "rejected"]
    assert result.stations[60].components[0].pose is None
    unchanged = estimate_joint(stations, _sections(), "independent")
    assert unchanged.stations[50].components[0].pose is None


def test_a_joint_that_jumps_from_station_to_station_is_not_continued():
    rng = np.random.default_rng(6)
    truth = _truth("const", rng) + rng.uniform(-0.01, 0.01, (1, N, 1)) * (1.0, 1.0, 0.0)
    stations = [dataclasses.replace(e, combined=None) for e in _stations(rng, truth)]
    _lose(stations, 30)
    assert estimate_joint(stations, _sections(), "kinked").stations[30].components[0].pose is None


def test_a_lost_component_goes_with_the_other_when_the_sensor_shakes():
    rng = np.random.default_rng(6)
    truth = _truth("linear", rng)
    truth[:, 30] += (9e-3, -7e-3, 0.0)
    stations = _stations(rng, truth)
    _lose(stations, 30, which=(0,))
    result = estimate_joint(stations, _sections(), "linear")
    assert result.stations[30].status.name == "weak"
    assert "other component" in result.stations[30].status.reason
    assert np.abs(_errors(result, truth)[:, 30, :2]).max() < 1.5e-3


def test_nothing_is_made_up_where_hardly_anything_is_measured():
    rng = np.random.default_rng(6)
    stations = _stations(rng, _truth("linear", rng))
    for i in range(0, N, 2):
        _lose(stations, i)
    result = estimate_joint(stations, _sections(), "auto")
    assert all(result.stations[i].components[0].pose is None for i in range(0, N, 2))


def test_independent_changes_nothing_and_unknown_models_are_refused():
    rng = np.random.default_rng(7)
    stations = _stations(rng, _truth("const", rng))
    assert estimate_joint(stations, _sections(), "independent").stations == tuple(stations)
    with pytest.raises(ConfigError, match="unknown motion model spline"):
        estimate_joint(stations, _sections(), "spline")


def test_stations_that_share_a_beam_cell_do_not_average():
    """A corner that stays between two beams is off by the same at every station, and the covariance knows."""
    rng = np.random.default_rng(8)
    pitch = np.sqrt(12.0) * SD[0]

    def sd_u(bearings):
        # stations put a corner in the middle of the cell that it is in
        noise = rng.normal(0.0, SD, (2, N, 3))
        noise[:, :, 0] = (np.floor(bearings) + 0.5 - bearings) * pitch
        stations = [
            dataclasses.replace(
                e,
                components=tuple(
                    dataclasses.replace(c, corner_step=float(np.floor(bearings[i]) + 0.5))
                    for c in e.components
                ),
            )
            for i, e in enumerate(_stations(_Given(noise), _truth("const", rng)))
        ]
        c = estimate_joint(stations, _sections(), "const").stations[41].components[0]
        arm = c.pose.turn(CORNERS[0])
        J = np.array([1.0, 0.0, -arm[1]])
        return float(np.sqrt(J @ c.covariance @ J))

    assert sd_u(np.full(N, 2.25)) == pytest.approx(SD[0], rel=0.05)
    assert sd_u(0.37 * np.arange(N)) < 0.35 * SD[0]


class _Given:
    """Hands out errors (2, N, 3) that were drawn before, a station and a component at a time."""

    def __init__(self, errors):
        self.errors = iter(errors.transpose(1, 0, 2).reshape(-1, 3))

    def normal(self, *_):
        return next(self.errors)


def test_correlation_of_cells_is_that_of_drawn_sawteeth():
    """Corners anywhere, their distances uncertain: errors of the middle of the cell, drawn and counted."""
    rng = np.random.default_rng(18)
    pitch, sd = 1.5e-3, 1.5e-3 / np.sqrt(12.0)
    places = np.array([0.2, 0.35, 0.7, 2.2, 9.9]) * pitch
    spread = np.diag(np.square([0.0, 0.05, 0.1, 0.2, 0.5]) * pitch**2)
    drawn = places + rng.normal(size=(200_000, 5)) * np.sqrt(np.diag(spread))
    drawn += rng.uniform(0.0, pitch, (200_000, 1))
    error = drawn - (np.floor(drawn / pitch) + 0.5) * pitch
    middle = (np.floor(places / pitch) + 0.5) * pitch
    rho = cell_correlation(np.full(5, sd), middle / pitch, places - middle, spread)
    off = ~np.eye(5, dtype=bool)
    assert np.allclose(rho[off], np.corrcoef(error.T)[off], atol=0.02)
    assert rho[0, 1] > 0.2 and rho[0, 2] < -0.2


def _random_sites(rng, n=30):
    s = np.sort(rng.uniform(0.0, 1.0, n))
    M = rng.normal(size=(n, 3, 3))
    precision = np.einsum("iab,icb->iac", M, M) * 1e6 + 1e5 * np.eye(3)
    return Sites(s, rng.normal(0.0, 3e-3, (n, 3)), precision, np.full(n, np.nan), np.ones(n))


def test_least_squares_agrees_with_numpy():
    rng = np.random.default_rng(9)
    sites = _random_sites(rng)
    basis = Basis(hats(sites.s, sites.s[[0, 9, 20, 29]]), np.ones((4, 3), bool))
    beta, cov = solve(sites, basis, np.ones(30))
    design = np.einsum("ik,ab->iakb", basis.functions, np.eye(3)).reshape(30, 3, 12)
    root = np.linalg.cholesky(sites.precision).transpose(0, 2, 1)
    A = (root @ design).reshape(90, -1)
    y = np.einsum("iab,ib->ia", root, sites.value).ravel()
    assert np.allclose(beta.ravel(), np.linalg.lstsq(A, y, rcond=None)[0], rtol=1e-6, atol=1e-9)
    assert np.allclose(cov, np.linalg.inv(A.T @ A), rtol=1e-5)


def test_evidence_differences_agree_with_the_dense_gaussian():
    rng = np.random.default_rng(10)
    sites = _random_sites(rng, 12)
    value = Evidence(sites)
    n = 12

    def dense(q):
        W = bends(sites.s)
        P = np.zeros((3 * n, 3 * n))
        L = np.zeros((3 * n, 3 * n))
        for a in range(3):
            P[a::3, a::3] = W / (q[0] if a < 2 else q[1]) ** 2
        for i in range(n):
            L[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = sites.precision[i]
        A = L + P + 1e-3 * np.eye(3 * n)
        b = L @ sites.value.ravel()
        ranks = -(n - 2) * (2 * np.log(q[0]) + np.log(q[1]))
        return 0.5 * b @ np.linalg.solve(A, b) - 0.5 * np.linalg.slogdet(A)[1] + ranks

    one, two = (0.02, 0.3), (0.5, 0.05)
    assert value(one) - value(two) == pytest.approx(dense(one) - dense(two), rel=1e-8)


def test_smooth_model_is_the_straight_line_in_the_limit():
    rng = np.random.default_rng(12)
    sites = dataclasses.replace(_random_sites(rng), s=np.linspace(0.0, 1.0, 30))
    stiff = fit(sites, smooth(sites.s, (1e-4, 1e-4)), rounds=0)
    line = fit(sites, polynomial(sites.s, turning=True), rounds=0)
    assert np.allclose(stiff.value, line.value, atol=2e-5)
    assert stiff.freedom == pytest.approx(6.0, abs=0.05)


def test_messages_along_the_knots_give_the_least_sum_of_squares():
    rng = np.random.default_rng(14)
    parts = (_random_sites(rng), _random_sites(rng))
    s = parts[0].s
    sums = np.empty((2, 31, kernels.COLUMNS))
    for sites, out in zip(parts, sums, strict=True):
        kernels.prefix_sums(s, sites.value, sites.precision, out)
    for knots in ([0, 29], [0, 7, 8, 20, 29], [0, 1, 2, 28, 29]):
        B = hats(s, s[knots])
        total = 0.0
        for sites in parts:
            root = np.linalg.cholesky(sites.precision).transpose(0, 2, 1)
            A = (root @ np.einsum("ik,ab->iakb", B, np.eye(3)).reshape(30, 3, -1)).reshape(90, -1)
            y = np.einsum("iab,ib->ia", root, sites.value).ravel()
            total += float(np.linalg.lstsq(A, y, rcond=None)[1][0])
        assert kernels.cost_of(s, sums, np.array(knots)) == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize("model", ["auto", "smooth", "kinked"])
def test_no_pattern_of_missing_stations_is_an_exception(model):
    rng = np.random.default_rng(15)
    every = _stations(rng, _truth("kinked", rng))
    sections = _sections()
    masks = [np.zeros(N, bool) for _ in range(6)]
    masks[0][:3] = masks[1][-3:] = masks[2][[0, 41, 82]] = masks[3][40:] = masks[4][[10, 11]] = True
    masks += [rng.random(N) < share for share in (0.05, 0.3, 0.95)]
    for mask in masks:
        stations = list(every)
        for i in np.flatnonzero(~mask):
            _lose(stations, i, which=(0, 1) if rng.random() < 0.7 else (rng.integers(2),))
        result = estimate_joint(stations, sections, model)
        for e in result.stations:
            for c in e.components:
                assert c.pose is None or np.isfinite([*c.pose.as_array(), *c.covariance.ravel()]).all()


def test_many_dense_stations_are_as_good_as_few_and_not_slow_beyond_reason():
    """Nodes are fewer than stations here: what they say together must still be what they say."""
    rng = np.random.default_rng(16)
    n = 600
    s = np.linspace(0.0, 1.2, n)
    truth = 5e-3 * np.sin(3.0 * s)[:, None] * np.array([1.0, 1.0, 4.0])
    precision = np.broadcast_to(np.diag(1.0 / SD**2), (n, 3, 3)).copy()
    sites = Sites(s, truth + rng.normal(0.0, SD, (n, 3)), precision, np.full(n, np.nan), np.ones(n))
    basis = smooth(s, (0.05, 0.2))
    assert basis.functions.shape[1] <= NODES + 1
    t = fit(sites, basis)
    error = (t.value - truth) / np.sqrt(np.diagonal(t.covariance, axis1=1, axis2=2))
    assert np.sqrt(np.mean((t.value - truth) ** 2, axis=0))[0] < SD[0] / 4.0
    assert np.all(np.abs(np.sqrt(np.mean(error**2, axis=0)) - 1.0) < 0.35)


def test_couplings_say_how_stations_err_together():
    """The diagonal is each station's own covariance, and two stations of a constant motion err as one."""
    rng = np.random.default_rng(17)
    result = estimate_joint(_stations(rng, _truth("const", rng)), _sections(), "const")
    poses = [e.components[0].pose for e in result.stations]
    gradients = rng.normal(size=(N, 3)) * (1.0, 1.0, 0.01)
    between = result.couplings[0].between(gradients, poses)
    own = [g @ e.components[0].covariance @ g for g, e in zip(gradients, result.stations, strict=True)]
    assert np.allclose(np.diag(between), own, rtol=1e-6)
    alike = result.couplings[0].between(np.tile([1.0, 0.0, 0.0], (N, 1)), poses)
    assert np.allclose(alike, alike[0, 0], rtol=1e-6)
    alone = estimate_joint(_stations(rng, _truth("const", rng)), _sections(), "independent")
    assert not alone.couplings[0].between(gradients, poses).any()
