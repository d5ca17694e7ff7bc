"""Bounds are bounds: over random tables, points and weights, on every level."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from bimfit.config import SearchConfig
from bimfit.registration import _kernels as kernels
from bimfit.registration import _kernels_table as table_kernels
from bimfit.registration import grcsm, majorant, table
from bimfit.registration.lattice import Lattice
from bimfit.registration.printed import run_brute, run_printed

QUICK = settings(max_examples=40, deadline=None, derandomize=True)


def random_leaf(rng, kind, height, width):
    """Noise, a smooth ridge, or a few spikes: what a majorant finds hard differs."""
    if kind == 0:
        return rng.integers(0, 256, (height, width)).astype(np.uint8)
    if kind == 1:
        y, x = np.mgrid[:height, :width]
        a, b = rng.uniform(-0.5, 0.5, 2)
        d = a * x + y - b * width - 0.5 * height
        return np.rint(255 * np.exp(-0.5 * (d / rng.uniform(1.0, 5.0)) ** 2)).astype(np.uint8)
    out = np.zeros((height, width), np.uint8)
    for _ in range(4):
        out[rng.integers(height), rng.integers(width)] = rng.integers(1, 256)
    return out


def random_problem(seed_, tests, levels, kind, bound, weighted, sigma=(0.5, 12.0)):
    rng = np.random.default_rng(seed_)
    half = tuple(float(0.5 * s**n) for s, n in zip(tests[:2], levels[:2], strict=True))  # cells of 1
    half_angle = float(rng.uniform(0.05, math.pi)) if rng.random() < 0.8 else math.pi
    lattice = Lattice((*half, half_angle), (1.0, 1.0, 2 * half_angle / tests[2] ** levels[2]), tests, levels)
    leaf = random_leaf(rng, kind, int(rng.integers(3, 40)), int(rng.integers(3, 60)))
    n = int(rng.integers(3, 25))
    points = rng.normal(0.0, 1.0, (n, 2)) * rng.uniform(1.0, 25.0)
    reach = float(np.hypot(*points.T).max())
    blur = float(rng.uniform(*sigma))
    made = table.tables_of_leaf(leaf, -np.array(half), (blur, blur), lattice, bound, reach)
    # small ones share the sums of 16 bits, great ones do not, and together they overflow them
    most = int(rng.choice([4, 40, 256]))
    weight = (rng.integers(0, most, n) if weighted else np.ones(n)).astype(np.uint64)
    start = np.array([*rng.uniform(-10, 60, 2), 1.0, 1.0, 0.0])
    return grcsm.Problem(
        made,
        (0.0, 0.0),
        points[:, 0].copy(),
        points[:, 1].copy(),
        weight,
        weight.astype(np.float32),
        1 / 255,
        start,
        0.0,
    )


def naive_scores(problem):
    """Every leaf's score with NumPy alone, shape (theta, v, u)."""
    tables, lattice = problem.tables, problem.tables.lattice
    nu, nv, nt = lattice.count
    leaf = tables.leaf.astype(np.int64)
    out = np.zeros((nt, nv, nu), np.int64)
    for t, angle in enumerate(lattice.angles):
        c, s = math.cos(angle), math.sin(angle)
        x = np.floor(c * problem.pu - s * problem.pv + problem.start[0]).astype(int)
        y = np.floor(s * problem.pu + c * problem.pv + problem.start[1]).astype(int)
        for v in range(nv):
            for u in range(nu):
                i, j = y + v, x + u
                inside = (i >= 0) & (i < leaf.shape[0]) & (j >= 0) & (j < leaf.shape[1])
                w = problem.weight[inside].astype(np.int64)
                out[t, v, u] = (w * leaf[i[inside], j[inside]]).sum()
    return out


SHAPES = st.tuples(st.integers(2, 5), st.integers(2, 5), st.integers(2, 5)).flatmap(
    lambda s: st.tuples(st.just(s), st.tuples(*[st.integers(0, 3 if a == 2 else 2) for a in s]))
)


@pytest.mark.parametrize("bound", ["majorant", "overlap"])
@seed(3)
@QUICK
@given(st.integers(0, 2**32 - 1), SHAPES, st.integers(0, 2), st.booleans())
def test_the_search_equals_a_naive_maximum(bound, seed_, shape, kind, weighted):
    problem = random_problem(seed_, *shape, kind, bound, weighted)
    scores = naive_scores(problem)
    best = np.unravel_index(np.argmax(scores), scores.shape)  # the first of the best in (theta, v, u)
    found = grcsm.run(problem, SearchConfig())
    assert found.score == scores[best]
    assert found.index == (best[2], best[1], best[0])
    assert found.stop == "proven" and found.bound == found.score
    brute = run_brute(problem, SearchConfig())
    assert (brute.score, brute.index) == (found.score, found.index)


def cells_at(problem, angle):
    cu, cv = np.empty(problem.n, np.int32), np.empty(problem.n, np.int32)
    c, s = problem.tables.cosine[angle], problem.tables.sine[angle]
    kernels.fill_cells(0, problem.n, c, s, problem.pu, problem.pv, problem.start, cu, cv)
    return cu, cv


@seed(4)
@QUICK
@given(st.integers(0, 2**32 - 1), SHAPES, st.integers(0, 2), st.booleans())
def test_no_block_holds_a_leaf_above_its_bound(seed_, shape, kind, weighted):
    """Block bounds of every node of every level, from the tables and slack classes the search reads."""
    problem = random_problem(seed_, *shape, kind, "overlap", weighted)
    tables, lattice, n = problem.tables, problem.tables.lattice, problem.n
    scores = naive_scores(problem)
    classes = np.empty((lattice.top + 1) * n, np.uint8)
    kernels.point_classes(
        n, problem.pu, problem.pv, 1.0, 1.0, 1, lattice.half_angle, tables.class_of, classes
    )
    for level in range(1, tables.first + 1):  # coarser ones are never asked for
        bu, bv, bt = (int(x) for x in lattice.size[level])
        nu, nv, nt = (int(x) for x in lattice.nodes[level])
        most = scores.reshape(nt, bt, nv, bv, nu, bu).max(axis=(1, 3, 5))
        at, tally = np.empty(2 * n, np.int32), np.empty(nv * (nu + table_kernels.RIM), np.int32)
        for t in range(nt):
            cu, cv = cells_at(problem, t * bt + bt // 2)
            lists, counts = np.empty((4, n), np.int32), np.empty(1, np.int32)
            kernels.merge_blocks(
                0, n, cu, cv, problem.weight, level * n, classes, bu, bv, at, lists, counts, 0
            )  # fmt: skip
            kernels.bound_box(
                0, n, lists, counts, tables.blocks, tables.block_place, level, 0, nv, 0, nu, tally
            )  # fmt: skip
            bounds = tally.reshape(nv, -1)[:, :nu]
            assert np.all(bounds >= most[t])
            if level == tables.first:
                stride = tables.block_place[level, 0, 5]
                part = np.empty(nv * stride + 2 * table_kernels.RIM, np.uint16)
                root = np.empty(nv * nu, np.int32)
                kernels.bound_root(
                    0, n, lists, counts, tables.blocks, tables.block_place, level, nv, nu, part, root, 0
                )
                assert np.array_equal(root.reshape(nv, nu), bounds)


@seed(10)
@QUICK
@given(st.integers(0, 2**32 - 1), SHAPES, st.integers(0, 2), st.booleans())
def test_no_child_holds_a_leaf_above_its_quadratic_bound(seed_, shape, kind, weighted):
    """Quadratic bounds of every child of random nodes of every level that has them."""
    problem = random_problem(seed_, *shape, kind, "majorant", weighted, sigma=(2.0, 8.0))
    tables, lattice, n = problem.tables, problem.tables.lattice, problem.n
    scores = naive_scores(problem)
    size, total = lattice.size, float(problem.weight.sum())
    cu, cv = (
        np.concatenate(c) for c in zip(*[cells_at(problem, t) for t in range(lattice.count[2])], strict=True)
    )
    at, words = np.empty(2 * max(n, kernels.RUN), np.int32), np.empty(kernels.RUN, np.uint64)
    coef, near = np.empty(5 * kernels.RUN, np.float32), np.empty(n, np.uint8)
    for level in np.flatnonzero(tables.quad_place[:, 0] >= 0):
        bu, bv, bt = (int(x) for x in size[level])
        lu, lv, lt = (int(x) for x in size[level - 1])
        scale, magnitude = tables.quad_scale[level, 2], tables.quad_scale[level, 3]
        margin = 1e-6 + kernels.ROUNDING * magnitude * total
        sums, turns = np.empty(6), np.empty(3 * bt)
        out = np.empty((bt // lt) * (bv // lv) * (bu // lu), np.int64)
        nu, nv, nt = (int(x) for x in lattice.nodes[level])
        some = np.random.default_rng(seed_).permutation(nt * nv * nu)[:30]
        for t, v, u in zip(*np.unravel_index(some, (nt, nv, nu)), strict=True):
            first, middle = t * bt, t * bt + bt // 2
            kernels.turn_classes(first, middle, bt, n, cu, cv, tables.class_of, level, at, 0, near)
            kernels.quad_node(
                n, first, middle, bt, u * bu + bu // 2, v * bv + bv // 2, cu, cv, 0, near, problem.heft,
                tables.quad_place, tables.quad_scale, level, tables.quads, at, words, words.view(np.int32),
                coef, sums, turns,
            )  # fmt: skip
            kernels.quad_children(size, level, sums, turns, scale, margin, -(1 << 60), out)
            box = scores[first : first + bt, v * bv : (v + 1) * bv, u * bu : (u + 1) * bu]
            most = box.reshape(bt // lt, lt, bv // lv, lv, bu // lu, lu).max(axis=(1, 3, 5))
            assert np.all(out.reshape(most.shape) >= most)


def unpacked(words):
    """A, gu, gv, huu, huv, hvv of quadratics' words, as integers."""
    field = lambda low, bits: ((words >> np.uint64(low)) & np.uint64((1 << bits) - 1)).astype(int)  # noqa: E731
    slopes = field(32, 12) - 2048, field(44, 12) - 2048
    return field(0, 16), *slopes, field(16, 8) - 128, field(56, 8) - 128, field(24, 8) - 128


@seed(5)
@QUICK
@given(
    st.integers(0, 2**32 - 1), st.integers(0, 2), st.tuples(*[st.integers(0, 5)] * 2),
    st.tuples(*[st.integers(0, 2)] * 2), st.integers(0, 7), st.booleans(),
)  # fmt: skip
def test_a_quadratic_lies_above_its_window(seed_, kind, radius, grain, steps, flat):
    rng = np.random.default_rng(seed_)
    leaf = random_leaf(rng, kind, int(rng.integers(1, 20)), int(rng.integers(1, 20)))
    (ru, rv), (eu, ev), steps = radius, grain, 2.0**steps
    unit_g, unit_h = 2.0 ** rng.integers(-4, 2), 2.0 ** rng.integers(-6, 2)
    rim_u, rim_v = (ru + (1 << eu) >> eu) + 1, (rv + (1 << ev) >> ev) + 1
    rows, columns = (leaf.shape[0] >> ev) + 2 * rim_v + 2, (leaf.shape[1] >> eu) + 2 * rim_u + 2
    most = 255.0 * steps
    if flat:
        out = np.empty((rows, columns), np.uint64)
        table_kernels.flat_table(leaf, ru, rv, eu, ev, rim_u, rim_v, steps, out)
    else:
        # among the tables of smaller and, outside the rims, of greater windows
        which, middle = int(rng.integers(0, 3)), np.array([ru + (1 << eu) // 2, rv + (1 << ev) // 2])
        smaller = np.minimum(middle, rng.integers(0, 3, 2))
        halves = np.array([*[middle - smaller] * which, middle, middle + rng.integers(0, 3, 2)])
        blank = table_kernels.pack_quad(0, 0, 0, 0, 0, 0)
        tables = np.full((len(halves), rows, columns), blank, np.uint64)
        units = steps, unit_g, unit_h
        most = majorant.fit_quads(leaf, halves, (eu, ev), (rim_u << eu, rim_v << ev), units, tables)
        out = tables[which]
    a, gu, gv, huu, huv, hvv = unpacked(out)
    far = 40
    wide = np.pad(leaf.astype(int), far)
    # every cell that a record serves, and every displacement from it that the record provides for
    for y in range(rows):
        for x in range(columns):
            middle_u, middle_v = (x - rim_u << eu) + (1 << eu >> 1), (y - rim_v << ev) + (1 << ev >> 1)
            du = np.arange((x - rim_u << eu) - ru, (x - rim_u + 1 << eu) + ru) - middle_u
            dv = np.arange((y - rim_v << ev) - rv, (y - rim_v + 1 << ev) + rv) - middle_v
            held = wide[np.ix_(far + middle_v + dv, far + middle_u + du)]
            u, v = du[None, :], dv[:, None]
            terms = (
                gu[y, x] * unit_g * u, gv[y, x] * unit_g * v, huu[y, x] * unit_h * u * u,
                huv[y, x] * unit_h * u * v, hvv[y, x] * unit_h * v * v,
            )  # fmt: skip
            assert np.all(held * steps <= a[y, x] + sum(terms))
            assert a[y, x] + sum(np.abs(t).max() for t in terms) <= most
    rim = np.concatenate([out[0], out[-1], out[:, 0], out[:, -1]])
    assert all(np.all(part == 0) for part in unpacked(rim))  # what lies outside counts nothing


@seed(6)
@QUICK
@given(st.integers(0, 2**32 - 1), SHAPES, st.integers(0, 2), st.floats(0.0, 0.5))
def test_collecting_finds_every_leaf_within_delta(seed_, shape, kind, delta):
    problem = random_problem(seed_, *shape, kind, "majorant", False)
    scores = naive_scores(problem)
    floor = max(1, math.ceil(scores.max() * (1.0 - delta)))
    codes, values = grcsm.run(problem, SearchConfig(), collect_from=floor).found
    t, v, u = np.nonzero(scores >= floor)
    expected = (t.astype(np.int64) << 40) | (v.astype(np.int64) << 20) | u
    order = np.argsort(codes)
    assert np.array_equal(codes[order], np.sort(expected))
    assert np.array_equal(values[order], scores[scores >= floor])


@seed(7)
@QUICK
@given(st.integers(0, 2**32 - 1), SHAPES, st.tuples(*[st.floats(0.05, 20.0)] * 3))
def test_a_prior_is_added_exactly(seed_, shape, sigma):
    problem = random_problem(seed_, *shape, 1, "majorant", False)
    lattice = problem.tables.lattice
    config = SearchConfig(prior_sigma=sigma, prior_weight=0.7)
    total = naive_scores(problem)
    for axis, where in ((0, 2), (1, 1), (2, 0)):
        motion = lattice.first[axis] + lattice.step[axis] * np.arange(lattice.count[axis])
        steps = np.rint(-0.5 * 0.7 * 255 * (motion / sigma[axis]) ** 2).astype(np.int64)
        total = total + np.expand_dims(steps, tuple(a for a in range(3) if a != where))
    best = np.unravel_index(np.argmax(total), total.shape)
    found = grcsm.run(problem, config)
    assert found.score == total[best]
    assert found.index == (best[2], best[1], best[0])


@seed(8)
@QUICK
@given(st.integers(0, 2**32 - 1), SHAPES, st.integers(1, 400), st.integers(0, 2))
def test_a_budget_leaves_a_true_bound(seed_, shape, limit, kind):
    problem = random_problem(seed_, *shape, kind, "majorant", False)
    most = int(naive_scores(problem).max())
    found = grcsm.run(problem, SearchConfig(max_evaluations=limit))
    assert found.score <= most <= found.bound
    if found.stop == "proven":
        assert found.score == most


def test_a_lattice_follows_the_paper():
    lattice = Lattice.of(SearchConfig())
    assert lattice.levels == (5, 5, 5) and lattice.count == (243, 243, 243)
    assert lattice.step[0] == pytest.approx(0.001)
    assert lattice.motion((121, 121, 121)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-15)
    two = Lattice.of(dataclasses.replace(SearchConfig(), levels=2))
    assert two.levels == (2, 2, 2) and two.tests == (16, 16, 13)


@seed(9)
@QUICK
@given(st.integers(0, 2**32 - 1), SHAPES, st.integers(0, 2))
def test_the_printed_search_scores_the_leaf_it_returns(seed_, shape, kind):
    """It may miss the best leaf, but what it reports is that leaf's score, and never more than the best."""
    problem = random_problem(seed_, *shape, kind, "block", False)
    scores = naive_scores(problem)
    found = run_printed(problem, SearchConfig())
    u, v, t = found.index
    assert found.score == scores[t, v, u] <= scores.max()
