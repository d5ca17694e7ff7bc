from dataclasses import replace

import numpy as np
import pytest

from bimfit.errors import ConfigError, SensorError
from bimfit.sensor.noise import NO_NOISE, Noise
from bimfit.sensor.replies import ReplyParser
from bimfit.sensor.scene import MovingScene, measurer
from bimfit.sensor.scip import Parameters, ScanRequest
from bimfit.sensor.sweep import Sweep, line_scan

HAS = Parameters()


def wall(distance):
    """A wall square ahead."""
    return lambda bearings: np.where(np.abs(bearings) < 1.2, distance / np.cos(bearings), np.nan)


def identical(values):
    both = (values[:, 1:] >= 20) & (values[:, :-1] >= 20)
    return np.mean((values[:, 1:] == values[:, :-1])[both])


@pytest.mark.parametrize("distance", [1.0, 1.5, 2.0])
def test_noise_is_as_recorded(distance):
    """Sigma 2.5 to 5 mm at 1 to 2 m, neighbours correlated 0.46 to 0.60, 26 to 34 % of them identical."""
    measure = measurer(wall(distance), HAS, Noise(dropouts=0.0), np.random.default_rng(0))
    ahead = slice(384 - 44 - 60, 384 - 44 + 61)
    values = np.array([measure(0.1 * k) for k in range(400)])[:, ahead]
    truth = 1000.0 * wall(distance)(HAS.bearings(np.arange(44, 726)))[ahead]
    errors = values - truth
    assert 2.4 < errors.std() < 5.3 and abs(errors.mean()) < 0.2
    correlation = np.mean(errors[:, 1:] * errors[:, :-1]) / np.mean(errors**2)
    assert 0.46 < correlation < 0.60
    assert 0.25 < identical(values) < 0.35


def test_the_recorded_scans_repeat_their_neighbours_as_often(ug01_reply, dialogue):
    for data in (ug01_reply, b"".join(data for _, data in dialogue[1])):
        values = ReplyParser().feed(data)[-1].values
        assert 0.26 < identical(values[None]) < 0.34


def test_without_noise_ranges_are_rounded_to_the_millimetre():
    truth = np.array([0.5004, 0.5006, np.nan, 0.019, 5.601, np.inf, 0.020, 5.6])
    codes = NO_NOISE.measure(truth, HAS, np.random.default_rng(0))
    assert codes[[0, 1, 6, 7]].tolist() == [500, 501, 20, 5600]
    assert all(code < 20 for code in codes[2:6])


def test_dropouts_are_codes():
    rng = np.random.default_rng(1)
    codes = Noise(dropouts=0.2).measure(np.full(50_000, 1.0), HAS, rng)
    lost = codes < 20
    assert 0.19 < lost.mean() < 0.21 and set(np.unique(codes[lost])) <= {6, 7}


@pytest.mark.parametrize("wrong", [{"sigma": -1.0}, {"correlation": 1.0}, {"held": 0.6}, {"dropouts": 1.0}])
def test_impossible_noise(wrong):
    with pytest.raises(ConfigError):
        Noise(**wrong)


def test_a_moving_scene_knows_each_beams_time():
    """Beams 299 to 469 are measured 29 to 46 ms after the stamp."""
    seen = {}

    def ranges(bearings, seconds):
        seen.update(bearings=bearings, seconds=seconds)
        return np.ones_like(bearings)

    measurer(MovingScene(ranges), HAS, NO_NOISE, np.random.default_rng(0))(7.0)
    delays = seen["seconds"][[299 - 44, 469 - 44]] - 7.0
    assert 0.029 <= delays[0] < 0.030 and 0.045 < delays[1] <= 0.046
    assert seen["bearings"][384 - 44] == 0.0


def sweep_of(values, index=0, request=None, stamp=10.0):
    request = request or ScanRequest("MD", 44, 725)
    return Sweep.from_values(index, np.asarray(values), request, HAS, stamp, stamp + 1e9)


def test_codes_become_missing_ranges_with_reasons():
    values = np.full(682, 1234)
    values[:6] = [0, 19, 20, 5600, 5601, 18]
    sweep = sweep_of(values)
    np.testing.assert_array_equal(sweep.ranges[:7], [np.nan, np.nan, 0.020, 5.6, np.nan, np.nan, 1.234])
    assert sweep.reasons[0].startswith("nothing in range") and sweep.reasons[1] == "not measurable"
    assert sweep.reasons[2] == "" and "beyond" in sweep.reasons[4] and "reflector" in sweep.reasons[5]
    assert not np.any(sweep.ranges == 0.0)
    assert sweep.times[384 - 44] == pytest.approx(sweep.stamp_host + 0.0375)


def test_two_characters_cannot_say_how_far_it_is_beyond_their_last():
    values, wide = np.array([4094, 4095, 19]), ScanRequest("MD", 44, 46)
    short = sweep_of(values, request=ScanRequest("MS", 44, 46))
    np.testing.assert_array_equal(short.ranges, [4.094, np.nan, np.nan])
    assert short.reasons == ("", "beyond the sensor's range", "not measurable")
    np.testing.assert_array_equal(sweep_of(values, request=wide).ranges, [4.094, 4.095, np.nan])


def test_recordings_are_replayed_as_they_are():
    rng = np.random.default_rng(2)
    rows = [rng.integers(0, 5600, 682) for _ in range(3)]
    for scene in (rows, [sweep_of(row, k) for k, row in enumerate(rows)]):
        measure = measurer(scene, HAS, Noise(), rng)
        for k in range(7):
            assert measure(0.1 * k).tolist() == rows[k % 3].tolist()


def test_a_line_scan_is_replayed_wherever_it_was_taken():
    rng = np.random.default_rng(3)
    request = ScanRequest("MD", 299, 469)
    rows = [rng.integers(20, 5600, 171) for _ in range(2)]
    rows[0][5] = 7
    axis, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = axis * np.sign(np.linalg.det(axis))
    pose[:3, 3] = [458657.0, 5438232.0, 3.0]
    scan = line_scan([sweep_of(row, k, request) for k, row in enumerate(rows)], pose)
    measure = measurer(scan, HAS, Noise(), rng)
    bare = measurer(replace(scan, extra={}), HAS, Noise(), rng)
    for k, row in enumerate(rows):
        got = measure(0.1 * k)
        assert got[299 - 44 : 470 - 44].tolist() == row.tolist()
        assert bare(0.1 * k)[299 - 44 : 470 - 44].tolist() == np.where(row < 20, 0, row).tolist()
        assert not got[: 299 - 44].any() and not got[470 - 44 :].any()


def test_scenes_that_do_not_fit():
    for scene in ([], [np.zeros(10, dtype=int)], [np.full(682, -1)]):
        with pytest.raises(SensorError):
            measurer(scene, HAS, Noise(), np.random.default_rng(0))


def test_a_line_scan_in_its_own_coordinates_knows_ahead():
    row = np.random.default_rng(5).integers(20, 5600, 682)  # no beam in the middle
    scan = replace(line_scan([sweep_of(row)]), extra={})
    assert measurer(scan, HAS, Noise(), None)(0.0).tolist() == row.tolist()


def test_a_scan_out_of_reach_is_told():
    scan = line_scan([sweep_of(np.full(682, 3000))])
    with pytest.raises(SensorError, match=r"nothing lies 0\.02 to 5\.6 m"):
        measurer(replace(scan, ranges=np.full(682, 22.0), extra={}), HAS, Noise(), None)


def test_parallel_beams_are_no_sweep():
    scan = line_scan([sweep_of(np.full(682, 1000))])
    with pytest.raises(SensorError, match="sweep 0: beams that are parallel"):
        measurer(replace(scan, directions=np.tile([0.0, 0.0, -1.0], (682, 1))), HAS, Noise(), None)


def test_line_scan_places_beams():
    sweeps = [sweep_of(np.full(171, 1000), k, ScanRequest("MD", 299, 469), 10.0 + k) for k in range(3)]
    own = line_scan(sweeps)
    assert len(own) == 513 and own.scan.tolist() == sorted(own.scan.tolist())
    np.testing.assert_allclose(np.linalg.norm(own.directions, axis=1), 1.0)
    np.testing.assert_allclose(own.directions[85], [1.0, 0.0, 0.0], atol=1e-12)
    assert own.directions[86, 1] > 0.0 and own.extra["code"][0] == 1000

    # One pose a sweep, and one a beam for a sensor that moves at 0.05 m/s: they differ by the delays.
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    poses[:, 2, 3] = [0.0, 0.05, 0.10]

    def at(times):
        moved = np.repeat(np.eye(4)[None], times.size, axis=0)
        moved[:, 2, 3] = 0.05 * (times - sweeps[0].stamp_host)
        return moved

    by_sweep, by_beam = line_scan(sweeps, poses), line_scan(sweeps, at)
    np.testing.assert_allclose(
        by_beam.origins[:, 2] - by_sweep.origins[:, 2], np.tile(0.05 * sweeps[0].delays, 3), atol=1e-7
    )
    with pytest.raises(SensorError, match="do not fit"):
        line_scan(sweeps, poses[:2])
    with pytest.raises(SensorError, match="no sweep"):
        line_scan([])
