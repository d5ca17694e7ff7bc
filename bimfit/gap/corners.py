"""Corners of a joint: sections on two legs meet in a mitre instead of cutting each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.geometry.pose import Array

#: Sections whose normals differ by more stand on two legs of a path, not on a curve (as in geometry.path).
CORNER = math.radians(20.0)
_U_TURN = math.radians(170.0)
_FAR = 3.0


@dataclass(frozen=True)
class Rungs:
    """One row of the ladder.

    Attributes
    ----------
    a, b : ndarray, shape (rungs, 3)
        World coordinates.
    opening : ndarray, shape (rungs,)
    normal : ndarray, shape (3,)
        Of the section.
    plane : ndarray, shape (2 * rungs, 2), or None
        Ring of the section in its own plane, A's side down and B's up; None for a mitre.
    """

    a: Array
    b: Array
    opening: Array
    normal: Array
    plane: Array | None


def with_mitres(rows: Sequence[Rungs], *, ring: bool = False) -> list[Rungs]:
    """Put a mitre between rows at a corner.

    Each rung's ends are carried on along both legs to where they meet. Rows that reach beyond their leg's
    end, which would cut the other leg's, are left out.

    Parameters
    ----------
    rows : sequence of Rungs
        In order along the joint.
    ring : bool
        Whether the last row leads into the first.
    """
    out = [rows[0]]
    for row in rows[1:]:
        _join(out, row)
    if ring and len(out) > 2:
        # The seam: join the first row to the end, then let whatever of it was left out go at the start, too.
        first = out[0]
        _join(out, first)
        while len(out) > 2 and out[-1] is not first:
            out.pop(0)
            first = out[0]
            _join(out, first)
        out.pop()
    return out


def _join(out: list[Rungs], row: Rungs) -> None:
    """Append a row, with a mitre where it turns; leave out rows, or itself, where they would cut."""
    while True:
        last = out[-1]
        turn = math.acos(max(-1.0, min(1.0, float(last.normal @ row.normal))))
        if not CORNER < turn < _U_TURN or last.plane is None:
            out.append(row)
            return
        mitre, before, after = _mitre(last, row)
        if mitre is None:
            out.append(row)
            return
        if before > 1e-9 and after > 1e-9:
            out += [mitre, row]
            return
        droppable = len(out) > 1 and out[-2].plane is not None
        if before < after and droppable:
            out.pop()
        elif after <= 1e-9:
            return
        else:
            out.append(row)
            return


def _mitre(p: Rungs, q: Rungs) -> tuple[Rungs | None, float, float]:
    """The row where two rows' rungs meet, and by how much at least it lies beyond p and before q."""
    c = float(p.normal @ q.normal)
    start, end = np.concatenate([p.a, p.b]), np.concatenate([q.a, q.b])
    d = end - start
    along_p, along_q = d @ p.normal, d @ q.normal
    alpha = (along_p - c * along_q) / (1.0 - c * c)
    beta = (along_q - c * along_p) / (1.0 - c * c)
    if max(float(np.abs(alpha).max()), float(np.abs(beta).max())) > _FAR * float(
        np.linalg.norm(d, axis=1).max()
    ):
        return None, 0.0, 0.0
    met = 0.5 * (start + alpha[:, None] * p.normal + end - beta[:, None] * q.normal)
    n = len(p.a)
    normal = p.normal + q.normal
    both = p.opening + q.opening
    # A rung that is closed on either leg is closed in the corner.
    opening = np.where((p.opening > 0.0) & (q.opening > 0.0), 0.5 * both, np.minimum(p.opening, q.opening))
    row = Rungs(met[:n], met[n:], opening, normal / np.linalg.norm(normal), None)
    return row, float(alpha.min()), float(beta.min())
