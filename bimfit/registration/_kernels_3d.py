"""Compiled loops of the search in space: blurred field, affine majorants, branch and bound.

Everything here counts in lattice cells; a cell's corner is a node of the field. Every kernel that calls
another lives in this file (METHOD, section 3).
"""

from __future__ import annotations

import math

import numpy as np

from bimfit._kernels import jit, jit_fast

BRICK = 4
"""Blocks an axis in a brick of majorants."""
A_SCALE = 32766.0
"""Integer steps of a majorant's height, which lies in [0, 1]."""
_FACTORS = (1.0, 0.6, 1.4)
_FAINT = 0.06
"""Where the field stays under this a constant serves as its majorant."""


@jit
def splat(points, normals, half, sigma, reach, field):
    """Raise ``field`` to the blurred nearness of each sample's tile; all lengths in cells.

    The distance to a tile is the one to its plane, and beyond ``half`` sideways the way there too.
    """
    nx, ny, nz = field.shape
    floor = math.exp(-0.5 * (reach / sigma) ** 2)
    steps = 4096
    table = np.empty(steps + 2)
    for i in range(steps + 2):
        d2 = i / steps * reach * reach
        table[i] = max(0.0, (math.exp(-0.5 * d2 / (sigma * sigma)) - floor) / (1.0 - floor))
    scale = steps / (reach * reach)
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        ax, ay, az = normals[k, 0], normals[k, 1], normals[k, 2]
        wide = reach + half
        for i in range(max(0, math.ceil(px - wide)), min(nx - 1, math.floor(px + wide)) + 1):
            dx = i - px
            for j in range(max(0, math.ceil(py - wide)), min(ny - 1, math.floor(py + wide)) + 1):
                dy = j - py
                for m in range(max(0, math.ceil(pz - wide)), min(nz - 1, math.floor(pz + wide)) + 1):
                    dz = m - pz
                    r = ax * dx + ay * dy + az * dz
                    if r > reach or r < -reach:
                        continue
                    side2 = dx * dx + dy * dy + dz * dz - r * r
                    d2 = r * r
                    if side2 > half * half:
                        extra = math.sqrt(side2) - half
                        d2 += extra * extra
                    f = d2 * scale
                    if f < steps:
                        value = table[int(f)]
                        if value > field[i, j, m]:
                            field[i, j, m] = value


@jit
def read(field, x, y, z):
    """Trilinear value of the field at a point in cells; 0 outside."""
    i = math.floor(x)
    j = math.floor(y)
    k = math.floor(z)
    if (
        i < 0
        or j < 0
        or k < 0
        or i >= field.shape[0] - 1
        or j >= field.shape[1] - 1
        or k >= field.shape[2] - 1
    ):
        return 0.0
    u = x - i
    v = y - j
    w = z - k
    a = field[i, j, k] * (1.0 - w) + field[i, j, k + 1] * w
    b = field[i, j + 1, k] * (1.0 - w) + field[i, j + 1, k + 1] * w
    c = field[i + 1, j, k] * (1.0 - w) + field[i + 1, j, k + 1] * w
    d = field[i + 1, j + 1, k] * (1.0 - w) + field[i + 1, j + 1, k + 1] * w
    return (a * (1.0 - v) + b * v) * (1.0 - u) + (c * (1.0 - v) + d * v) * u


@jit
def mark_bricks(field, radius, block, pad, index):
    """Set ``index`` to 1 for every brick with a block whose region meets the field's support."""
    side = block * BRICK
    nx, ny, nz = field.shape
    bx, by, bz = index.shape
    for i in range(nx):
        for j in range(ny):
            open_run = False
            start = 0
            for k in range(nz + 1):
                filled = k < nz and field[i, j, k] > 0.0
                if filled and not open_run:
                    start, open_run = k, True
                elif open_run and not filled:
                    open_run = False
                    # A node bears on the cells around it: one cell more on every side.
                    for a in range(
                        max(0, math.floor((i - 1 - radius + pad) / side)),
                        min(bx - 1, math.floor((i + 1 + radius + pad) / side)) + 1,
                    ):
                        for b in range(
                            max(0, math.floor((j - 1 - radius + pad) / side)),
                            min(by - 1, math.floor((j + 1 + radius + pad) / side)) + 1,
                        ):
                            for c in range(
                                max(0, math.floor((start - 1 - radius + pad) / side)),
                                min(bz - 1, math.floor((k + radius + pad) / side)) + 1,
                            ):
                                index[a, b, c] = 1


@jit
def _coordinates(low, high, out):
    """The ends of an interval and the lattice planes between, ascending; returns how many."""
    first = math.floor(low)
    n = math.ceil(high) - first + 1
    for i in range(n):
        out[i] = first + i
    out[0] = low
    out[n - 1] = high
    return n


@jit
def _region_values(field, cx, cy, cz, nx, ny, nz, values):
    """Field values at the product of three coordinate lists; returns the greatest.

    Reads whole nodes, then draws the outer planes in to where the region ends, an axis at a time: that
    is trilinear interpolation.
    """
    sx, sy, sz = field.shape
    x0 = math.floor(cx[0])
    y0 = math.floor(cy[0])
    z0 = math.floor(cz[0])
    top = 0.0
    for i in range(nx):
        x = x0 + i
        for j in range(ny):
            y = y0 + j
            if x < 0 or y < 0 or x >= sx or y >= sy:
                for k in range(nz):
                    values[i, j, k] = 0.0
                continue
            for k in range(nz):
                z = z0 + k
                value = field[x, y, z] if 0 <= z < sz else 0.0
                values[i, j, k] = value
                if value > top:
                    top = value
    if top == 0.0:
        return 0.0
    f = cx[0] - x0
    if f > 0.0:
        for j in range(ny):
            for k in range(nz):
                values[0, j, k] += f * (values[1, j, k] - values[0, j, k])
                values[nx - 1, j, k] += f * (values[nx - 2, j, k] - values[nx - 1, j, k])
    f = cy[0] - y0
    if f > 0.0:
        for i in range(nx):
            for k in range(nz):
                values[i, 0, k] += f * (values[i, 1, k] - values[i, 0, k])
                values[i, ny - 1, k] += f * (values[i, ny - 2, k] - values[i, ny - 1, k])
    f = cz[0] - z0
    if f > 0.0:
        for i in range(nx):
            for j in range(ny):
                values[i, j, 0] += f * (values[i, j, 1] - values[i, j, 0])
                values[i, j, nz - 1] += f * (values[i, j, nz - 2] - values[i, j, nz - 1])
    return top


# Reassociation is safe in the two sums below: their values are finite, and the height is rounded up after.
@jit_fast
def _heights(values, cx, cy, cz, nx, ny, nz, mx, my, mz, gx, gy, gz, stride, factors, out):
    """Least A with A + factor g . (y - m) at least the values, for three factors."""
    f0, f1, f2 = factors
    a0 = a1 = a2 = -1e30
    for i in range(0, nx, stride):
        a = gx * (cx[i] - mx)
        for j in range(0, ny, stride):
            b = a + gy * (cy[j] - my)
            for k in range(0, nz, stride):
                v = values[i, j, k]
                h = b + gz * (cz[k] - mz)
                a0 = max(a0, v - f0 * h)
                a1 = max(a1, v - f1 * h)
                a2 = max(a2, v - f2 * h)
    out[0] = a0
    out[1] = a1
    out[2] = a2


@jit_fast
def _height(values, cx, cy, cz, nx, ny, nz, mx, my, mz, gx, gy, gz):
    """Least A with A + g . (y - m) at least the values."""
    top = -1e30
    for i in range(nx):
        a = gx * (cx[i] - mx)
        for j in range(ny):
            b = a + gy * (cy[j] - my)
            for k in range(nz):
                top = max(top, values[i, j, k] - b - gz * (cz[k] - mz))
    return top


@jit_fast
def _slopes(values, cx, cy, cz, nx, ny, nz, mx, my, mz, stride):
    """Least-squares slopes of the values about their region's middle."""
    sx = sy = sz = 0.0
    qx = qy = qz = 0.0
    for i in range(0, nx, stride):
        x = cx[i] - mx
        for j in range(0, ny, stride):
            y = cy[j] - my
            sheet = 0.0
            tilt = 0.0
            square = 0.0
            count = 0
            for k in range(0, nz, stride):
                z = cz[k] - mz
                v = values[i, j, k]
                sheet += v
                tilt += z * v
                square += z * z
                count += 1
            sx += x * sheet
            sy += y * sheet
            sz += tilt
            qx += x * x * count
            qy += y * y * count
            qz += square
    return sx / qx, sy / qy, sz / qz


@jit
def fill_bricks(field, radius, block, pad, index, g_scale, records):
    """Compute the majorants of all bricks that ``index`` numbers (0: none) into ``records``.

    A record (A, gx, gy, gz) of int16 holds A / A_SCALE + (g / g_scale) . (y - m) >= field(y) for every
    point y of the block widened by ``radius``, m being its middle. The field is trilinear between
    nodes, so that an affine majorant at the corners of every piece is one everywhere.
    """
    most = int(block + 2 * radius) + 4
    values = np.empty((most, most, most))
    heights = np.empty(3)
    cx = np.empty(most)
    cy = np.empty(most)
    cz = np.empty(most)
    for a in range(index.shape[0]):
        for b in range(index.shape[1]):
            for c in range(index.shape[2]):
                brick = index[a, b, c]
                if brick == 0:
                    continue
                for n in range(BRICK**3):
                    lx = (a * BRICK + n // 16) * block - pad
                    ly = (b * BRICK + n // 4 % 4) * block - pad
                    lz = (c * BRICK + n % 4) * block - pad
                    nx = _coordinates(lx - radius, lx + block + radius, cx)
                    ny = _coordinates(ly - radius, ly + block + radius, cy)
                    nz = _coordinates(lz - radius, lz + block + radius, cz)
                    top = _region_values(field, cx, cy, cz, nx, ny, nz, values)
                    if top <= 0.0:
                        continue
                    mx, my, mz = lx + 0.5 * block, ly + 0.5 * block, lz + 0.5 * block
                    kx = ky = kz = 0
                    best = top
                    if top > _FAINT:
                        stride = 1 if nx < 10 else nx // 8
                        sx, sy, sz = _slopes(values, cx, cy, cz, nx, ny, nz, mx, my, mz, stride)
                        _heights(
                            values, cx, cy, cz, nx, ny, nz, mx, my, mz, sx, sy, sz, stride, _FACTORS, heights
                        )
                        least = np.argmin(heights)
                        if heights[least] < top:
                            f = _FACTORS[least] * g_scale
                            kx = min(32767, max(-32767, round(sx * f)))
                            ky = min(32767, max(-32767, round(sy * f)))
                            kz = min(32767, max(-32767, round(sz * f)))
                            gx, gy, gz = kx / g_scale, ky / g_scale, kz / g_scale
                            best = _height(values, cx, cy, cz, nx, ny, nz, mx, my, mz, gx, gy, gz)
                            if best > top:
                                best = top
                                kx = ky = kz = 0
                    at = brick * BRICK**3 + n
                    records[at, 0] = min(32767, math.floor(best * A_SCALE) + 1)
                    records[at, 1] = kx
                    records[at, 2] = ky
                    records[at, 3] = kz


@jit
def rotation(w, R, J):
    """Rotation matrix R of a rotation vector and its left Jacobian J."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    t = math.sqrt(t2)
    if t < 1e-5:
        a, b, c = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    else:
        a, b, c = math.sin(t) / t, (1.0 - math.cos(t)) / t2, (t - math.sin(t)) / (t2 * t)
    for i in range(3):
        for j in range(3):
            outer = w[i] * w[j]
            eye = 1.0 if i == j else 0.0
            R[i, j] = (1.0 - b * t2) * eye + b * outer
            J[i, j] = (1.0 - c * t2) * eye + c * outer
    for i, j, s, m in (
        (0, 1, -1.0, 2),
        (0, 2, 1.0, 1),
        (1, 0, 1.0, 2),
        (1, 2, -1.0, 0),
        (2, 0, -1.0, 1),
        (2, 1, 1.0, 0),
    ):
        R[i, j] += a * s * w[m]
        J[i, j] += b * s * w[m]


@jit
def score_at(field, points, weights, pivot, pose, R, J):
    """Sum of weighted field values of the points turned by ``pose[3:]`` about the pivot and shifted."""
    rotation(pose[3:], R, J)
    tx = pivot[0] + pose[0]
    ty = pivot[1] + pose[1]
    tz = pivot[2] + pose[2]
    total = 0.0
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        total += weights[k] * read(
            field,
            R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + tx,
            R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + ty,
            R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + tz,
        )
    return total


@jit
def pose_of(x0, V, steps, at, pose):
    """Pose (6,) of lattice coordinates ``at`` (d,), which need not be whole."""
    for i in range(6):
        pose[i] = x0[i]
        for j in range(at.shape[0]):
            pose[i] += V[i, j] * steps[j] * at[j]


@jit
def bound_node(points, rho, weights, pivot, pose, half, V, tables, R, J, slope):
    """Upper bound of the score over a box of poses around ``pose``.

    Parameters
    ----------
    half : (d,) half widths along the columns of ``V`` (6, d)
    tables : classes' radii, look-up of the class, blocks and their inverses, pads, shapes, offsets,
        bricks, records, scale
    slope : (d,) receives the bound's slope along each column

    Returns
    -------
    The constant part of the bound: it is that plus sum |slope| half.
    """
    radii, choose, per_cell, blocks, inverses, pads, shapes, starts, bricks, records, g_scale = tables
    rotation(pose[3:], R, J)
    d = half.shape[0]
    ht = np.zeros(3)
    he = np.zeros(3)
    for j in range(d):
        for i in range(3):
            ht[i] += abs(V[i, j]) * half[j]
            he[i] += abs(V[3 + i, j]) * half[j]
    eta2 = he[0] * he[0] + he[1] * he[1] + he[2] * he[2]
    # |phi_i| of the first-order rotation phi = J eta
    f0 = abs(J[0, 0]) * he[0] + abs(J[0, 1]) * he[1] + abs(J[0, 2]) * he[2]
    f1 = abs(J[1, 0]) * he[0] + abs(J[1, 1]) * he[1] + abs(J[1, 2]) * he[2]
    f2 = abs(J[2, 0]) * he[0] + abs(J[2, 1]) * he[1] + abs(J[2, 2]) * he[2]
    tx = pivot[0] + pose[0]
    ty = pivot[1] + pose[1]
    tz = pivot[2] + pose[2]
    limit = radii[-1]
    inv_a = 1.0 / A_SCALE
    inv_g = 1.0 / g_scale
    base = 0.0
    sgx = sgy = sgz = 0.0
    smx = smy = smz = 0.0
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        ax = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        ay = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        az = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        # What rotation leaves beyond first order is at most eta^2 rho / 2 (second derivative of exp).
        rest = 0.5 * eta2 * rho[k]
        reach = ht[0] + f1 * abs(az) + f2 * abs(ay)
        other = ht[1] + f2 * abs(ax) + f0 * abs(az)
        if other > reach:
            reach = other
        other = ht[2] + f0 * abs(ay) + f1 * abs(ax)
        if other > reach:
            reach = other
        reach += rest
        w = weights[k]
        if reach > limit:
            base += w
            continue
        c = choose[int(reach * per_cell) + 1]
        x = ax + tx + pads[c]
        y = ay + ty + pads[c]
        z = az + tz + pads[c]
        if x < 0.0 or y < 0.0 or z < 0.0:
            continue
        block = blocks[c]
        inverse = inverses[c]
        bx = int(x * inverse)
        by = int(y * inverse)
        bz = int(z * inverse)
        ix = bx >> 2
        iy = by >> 2
        iz = bz >> 2
        if ix >= shapes[c, 0] or iy >= shapes[c, 1] or iz >= shapes[c, 2]:
            continue
        brick = bricks[starts[c] + (ix * shapes[c, 1] + iy) * shapes[c, 2] + iz]
        if brick == 0:
            continue
        at = brick * 64 + ((bx & 3) * 4 + (by & 3)) * 4 + (bz & 3)
        height = records[at, 0]
        if height == 0:
            continue
        gx = records[at, 1] * inv_g * w
        gy = records[at, 2] * inv_g * w
        gz = records[at, 3] * inv_g * w
        base += (
            w * height * inv_a
            + gx * (x - (bx + 0.5) * block)
            + gy * (y - (by + 0.5) * block)
            + gz * (z - (bz + 0.5) * block)
        )
        if rest > 0.0:
            base += rest * math.sqrt(gx * gx + gy * gy + gz * gz)
        sgx += gx
        sgy += gy
        sgz += gz
        smx += ay * gz - az * gy
        smy += az * gx - ax * gz
        smz += ax * gy - ay * gx
    e0 = J[0, 0] * smx + J[1, 0] * smy + J[2, 0] * smz
    e1 = J[0, 1] * smx + J[1, 1] * smy + J[2, 1] * smz
    e2 = J[0, 2] * smx + J[1, 2] * smy + J[2, 2] * smz
    for j in range(d):
        slope[j] = V[0, j] * sgx + V[1, j] * sgy + V[2, j] * sgz + V[3, j] * e0 + V[4, j] * e1 + V[5, j] * e2
    return base


@jit
def penalty(prior, pose):
    """What a Gaussian prior adds to the score of a pose (6,): -1/2 sum of prior (6,) times its squares."""
    total = 0.0
    for k in range(6):
        total -= 0.5 * prior[k] * pose[k] * pose[k]
    return total


@jit
def climb(field, points, weights, pivot, x0, V, steps, reach, prior, at, first):
    """Climb on the lattice from ``at`` (d,) by steps of ``first`` down to 1; returns score, evaluations."""
    R = np.empty((3, 3))
    J = np.empty((3, 3))
    pose = np.empty(6)
    d = at.shape[0]
    pose_of(x0, V, steps, at, pose)
    best = score_at(field, points, weights, pivot, pose, R, J) + penalty(prior, pose)
    count = 1
    jump = first
    while jump >= 1:
        moved = True
        while moved:
            moved = False
            for j in range(d):
                for sign in (-1.0, 1.0):
                    old = at[j]
                    new = old + sign * jump
                    if abs(new) > reach[j]:
                        continue
                    at[j] = new
                    pose_of(x0, V, steps, at, pose)
                    score = score_at(field, points, weights, pivot, pose, R, J) + penalty(prior, pose)
                    count += 1
                    if score > best:
                        best = score
                        moved = True
                    else:
                        at[j] = old
        jump //= 2
    return best, count


@jit
def _before(keys, a, b):
    """Whether node a comes before b: the greater bound, then the lesser slot."""
    return keys[a] > keys[b] or (keys[a] == keys[b] and a < b)


@jit
def push(heap, keys, size, node):
    """Add a node to the heap; returns the new size."""
    i = size
    heap[i] = node
    while i > 0:
        up = (i - 1) >> 1
        if not _before(keys, heap[i], heap[up]):
            break
        heap[i], heap[up] = heap[up], heap[i]
        i = up
    return size + 1


@jit
def pop(heap, keys, size):
    """Take the first node off the heap; returns (node, new size)."""
    first = heap[0]
    size -= 1
    heap[0] = heap[size]
    i = 0
    while True:
        left = 2 * i + 1
        if left >= size:
            break
        least = left
        if left + 1 < size and _before(keys, heap[left + 1], heap[left]):
            least = left + 1
        if not _before(keys, heap[least], heap[i]):
            break
        heap[i], heap[least] = heap[least], heap[i]
        i = least
    return first, size


@jit
def _in_zone(low, high, node, zones, count, zone_half):
    """Whether a node lies wholly in the neighbourhood of a mode that is known."""
    for m in range(count):
        inside = True
        for j in range(low.shape[1]):
            if low[node, j] < zones[m, j] - zone_half[j] or high[node, j] > zones[m, j] + zone_half[j]:
                inside = False
                break
        if inside:
            return True
    return False


@jit
def search(problem, tables, nodes, state, best_at, motion, settings, zones, zone_half):
    """Branch and bound, best first, until proven, out of budget, or out of room for nodes.

    Parameters
    ----------
    problem : field, points, rho, weights, pivot, x0, V, steps, reach, prior
    nodes : keys, low, high, heap, free
    state : float64: 0 best score, 1 heap size, 2 nodes made, 3 free nodes, 4 evaluations,
        5 greatest bound set aside, 6 known zones, 7 score of a new mode
    settings : eps, delta, evaluations allowed, phase (0: prove, 1: collect rival modes)

    Returns
    -------
    int : 0 done, 1 evaluations used up, 2 no room, 3 a new mode was found (in ``best_at`` row 1)
    """
    field, points, rho, weights, pivot, x0, V, steps, reach, prior = problem
    keys, low, high, heap, free = nodes
    eps, delta, allowed, phase = settings
    d = steps.shape[0]
    R = np.empty((3, 3))
    J = np.empty((3, 3))
    pose = np.empty(6)
    at = np.empty(d)
    half = np.empty(d)
    slope = np.empty(d)
    size = int(state[1])
    made = int(state[2])
    spare = int(state[3])
    verdict = 0
    since = 0
    while size > 0:
        if state[4] >= allowed:
            verdict = 1
            break
        if made + 2 >= keys.shape[0] and spare < 2:
            verdict = 2
            break
        top = keys[heap[0]]
        goal = state[0] * (1.0 + eps) if phase == 0.0 else state[0] * (1.0 - delta)
        if top <= goal:
            break
        node, size = pop(heap, keys, size)
        free[spare] = node
        spare += 1
        if phase == 1.0 and _in_zone(low, high, node, zones, int(state[6]), zone_half):
            continue
        single = True
        for j in range(d):
            at[j] = 0.5 * (low[node, j] + high[node, j])
            half[j] = 0.5 * (high[node, j] - low[node, j]) * steps[j]
            if high[node, j] > low[node, j]:
                single = False
        pose_of(x0, V, steps, at, pose)
        state[4] += 1.0
        if single:
            score = score_at(field, points, weights, pivot, pose, R, J) + penalty(prior, pose)
            if phase == 0.0 and score > state[0]:
                state[0] = score
                best_at[0, :] = at
            elif phase == 1.0 and score > goal:
                best_at[1, :] = at
                state[7] = score
                verdict = 3
                break
            continue
        whole = bound_node(points, rho, weights, pivot, pose, half, V, tables, R, J, slope)
        # a concave prior lies under its tangent at the middle
        whole += penalty(prior, pose)
        for j in range(d):
            for k in range(6):
                slope[j] -= prior[k] * pose[k] * V[k, j]
        for j in range(d):
            whole += abs(slope[j]) * half[j]
        ceiling = min(top, whole)
        if ceiling <= goal:
            if phase == 1.0:
                continue
            if ceiling > state[5]:
                state[5] = ceiling
            # What may hold a rival mode is kept for the second phase.
            if delta == 0.0 or ceiling <= state[0] * (1.0 - delta):
                continue
        since += 1
        if since >= 12:
            # The middle of the most promising box: now and then it beats the incumbent.
            since = 0
            for j in range(d):
                at[j] = math.floor(at[j])
            if phase == 0.0:
                pose_of(x0, V, steps, at, pose)
                score = score_at(field, points, weights, pivot, pose, R, J) + penalty(prior, pose)
                state[4] += 1.0
                if score > state[0]:
                    state[0], count = climb(field, points, weights, pivot, x0, V, steps, reach, prior, at, 4)
                    state[4] += count
                    best_at[0, :] = at
        axis = 0
        widest = -1.0
        for j in range(d):
            if high[node, j] > low[node, j] and half[j] * motion[j] > widest:
                widest = half[j] * motion[j]
                axis = j
        lo, hi = low[node, axis], high[node, axis]
        middle = (lo + hi) // 2
        for side in range(2):
            spare_node = made
            if side == 1:
                spare -= 1
                spare_node = free[spare]
            elif spare >= 2:
                spare_node = free[spare - 2]
                free[spare - 2] = free[spare - 1]
                spare -= 1
            else:
                made += 1
            a, b = (lo, middle) if side == 0 else (middle + 1, hi)
            if side == 0:
                for j in range(d):
                    low[spare_node, j] = low[node, j]
                    high[spare_node, j] = high[node, j]
            low[spare_node, axis] = a
            high[spare_node, axis] = b
            h = 0.5 * (b - a) * steps[axis]
            shift = (0.5 * (a + b) - 0.5 * (lo + hi)) * steps[axis]
            part = whole - abs(slope[axis]) * half[axis] + slope[axis] * shift + abs(slope[axis]) * h
            keys[spare_node] = min(ceiling, part)
            size = push(heap, keys, size, spare_node)
    state[1] = size
    state[2] = made
    state[3] = spare
    return verdict
