"""Gathering in one pass: the same whatever the pieces, thinning by no accident of their order."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.errors import ScanError
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud
from bimfit.scan.nearby import Gatherer, Nearby, read_ahead

PLACES = Boxes.of(np.array([[[-1, -1, -1], [0.5, 1, 1]], [[0, 0, 0], [2, 1, 1]], [[2.5, -3, -1], [3, 3, 1]]]))


def gathered(points: np.ndarray, ends: list[int], most: int = 10**9, eyes: tuple = ()) -> Nearby:
    gatherer = Gatherer(PLACES, most)
    cuts = [0, *sorted(ends), len(points)]
    for k in range(len(cuts) - 1):
        eye = np.array(eyes[k % len(eyes)], float) if eyes else None
        gatherer.add(PointCloud(points[cuts[k] : cuts[k + 1]], eye, notes=("made up",)))
    return gatherer.done()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    ends=st.lists(st.integers(0, 2000), max_size=9),
    most=st.sampled_from([50, 300, 10**9]),
)
def test_pieces_do_not_matter(seed: int, ends: list[int], most: int) -> None:
    points = np.random.default_rng(seed).uniform(-4, 4, (2000, 3))
    whole, pieces = gathered(points, [], most), gathered(points, ends, most)
    assert np.array_equal(whole.scan.points, pieces.scan.points)
    assert whole.level == pieces.level
    assert whole.scan.notes == pieces.scan.notes
    assert len(whole.scan) <= most
    if most == 10**9:
        assert np.array_equal(whole.scan.points, points[PLACES.inside(points)])
    for k in range(len(PLACES)):
        own = Boxes(PLACES.array[k : k + 1])
        expected = whole.scan.points[own.inside(whole.scan.points)]
        assert np.array_equal(pieces.around(own).points, expected)
    shuffled = gathered(np.random.default_rng(1).permutation(points), ends, most)
    key = lambda p: p[np.lexsort(p.T)]  # noqa: E731
    assert np.array_equal(key(shuffled.scan.points), key(whole.scan.points))


def test_thinning_keeps_an_even_share() -> None:
    """Half a time of a billion-cell lattice, too, whose coordinates differ in few bits."""
    grid = np.stack(np.meshgrid(*[np.arange(60) * 0.01] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for points in (grid, np.array([458_657.0, 5_438_232.0, 0.0]) + grid):
        gatherer = Gatherer(Boxes.of(np.array([points.min(axis=0), points.max(axis=0)])[None]), 20_000)
        gatherer.add(PointCloud(points))
        kept = gatherer.done()
        assert kept.level == 4
        share = len(kept.scan) / len(points)
        assert share == pytest.approx(1 / 16, rel=0.06)
        for axis in range(3):
            counts = np.histogram(kept.scan.points[:, axis], 6)[0]
            assert counts == pytest.approx(len(kept.scan) / 6, rel=0.1)
        assert "one in 16" in kept.scan.notes[-1]


def test_each_place_is_seen_from_where_most_of_it_was() -> None:
    rng = np.random.default_rng(3)
    left = rng.uniform(-1, 0, (500, 3))
    right = np.concatenate([rng.uniform(-1, 0, (50, 3)), rng.uniform((2.5, -3, -1), (3, 3, 1), (300, 3))])
    near = gathered(np.concatenate([left, right]), [500], eyes=((0, 0, 5), (9, 0, 5)))
    assert near.around(Boxes(PLACES.array[:1])).viewpoint.tolist() == [0, 0, 5]
    assert near.around(Boxes(PLACES.array[2:])).viewpoint.tolist() == [9, 0, 5]
    nowhere = near.around(Boxes.of(np.array([[[50, 50, 50], [51, 51, 51]]])))
    assert len(nowhere) == 0
    assert nowhere.viewpoint is None
    assert gathered(left, [200]).around(PLACES).viewpoint is None


def test_reading_ahead_changes_nothing_and_ends() -> None:
    before = threading.active_count()
    assert list(read_ahead(iter(range(50)))) == list(range(50))

    def broken():
        yield 1
        raise ScanError("cut short")

    drawn = []
    with pytest.raises(ScanError, match="cut short"):
        for piece in read_ahead(broken()):
            drawn.append(piece)
    assert drawn == [1]
    some = read_ahead(iter(range(10**9)))
    assert next(some) == 0
    some.close()
    assert threading.active_count() == before
