"""The way a moving sensor took: TUM files, a pose for every beam's own time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.formats.text import first_lines, number_at, read_table

if TYPE_CHECKING:
    from scipy.spatial.transform import Slerp

COLUMNS = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
_UNIT_SLACK = 0.01


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses at times, straight and steadily turning in between.

    Attributes
    ----------
    times : ndarray, shape (n,)
        Ascending, s.
    positions : ndarray, shape (n, 3)
        m.
    quaternions : ndarray, shape (n, 4)
        Unit quaternions x, y, z, w: T_world_body.
    source : str
    """

    times: Array
    positions: Array
    quaternions: Array
    source: str = ""

    def poses(self, times: ArrayLike) -> Array:
        """T_world_body at times (m,), shape (m, 4, 4).

        Positions are interpolated linearly, orientations by slerp (Shoemake 1985).

        Raises
        ------
        ScanError
            When a time lies outside the trajectory, or is none.
        """
        t = np.asarray(times, np.float64).reshape(-1)
        first, last = float(self.times[0]), float(self.times[-1])
        if len(t) and not (t.min() >= first and t.max() <= last):
            said = "are no numbers" if np.isnan(t).any() else f"run from {t.min():.6f} to {t.max():.6f} s"
            raise ScanError(
                f"the trajectory runs from {first:.6f} to {last:.6f} s, but times of the scan's beams {said}",
                file=self.source or None,
                remedy="both must count by one clock, and the trajectory must cover the whole scan",
            )
        out = np.zeros((len(t), 4, 4))
        out[:, 3, 3] = 1.0
        if len(self.times) == 1:
            return self._one(out)
        out[:, :3, :3] = self._turns(t).as_matrix()
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        share = ((t - self.times[k]) / (self.times[k + 1] - self.times[k]))[:, None]
        out[:, :3, 3] = self.positions[k] + share * (self.positions[k + 1] - self.positions[k])
        return out

    def _one(self, out: Array) -> Array:
        from scipy.spatial.transform import Rotation

        out[:, :3, :3] = Rotation.from_quat(self.quaternions[0]).as_matrix()
        out[:, :3, 3] = self.positions[0]
        return out

    @cached_property
    def _turns(self) -> Slerp:
        from scipy.spatial.transform import Rotation, Slerp

        return Slerp(self.times, Rotation.from_quat(self.quaternions))

    def carry(self, scan: LineScan) -> LineScan:
        """A scan in the moving body's coordinates, laid out in the world by each beam's own ``time``.

        Raises
        ------
        ScanError
            When the scan has no column ``time``, or times outside the trajectory.
        """
        if "time" not in scan.extra:
            raise ScanError(
                "a trajectory needs the time of every beam, and the scan has no column time",
                file=scan.source or None,
                remedy="bimfit capture writes it; else add a column time, s",
            )
        return scan.laid_out(self.poses(np.asarray(scan.extra["time"], np.float64)))


def read_tum(path: Path) -> Trajectory:
    """Read a trajectory in TUM format: a line ``time x y z qx qy qz qw`` a pose; ``#`` begins a comment.

    Raises
    ------
    ScanError
        Naming the line: text in a number, another number of columns, times that do not ascend, a quaternion
        that is not of unit length.
    """
    head = first_lines(path)
    lines = head.split(b"\n")
    bare = [bool(line.strip()) and not line.lstrip().startswith(b"#") for line in lines]
    skip = bare.index(True) if any(bare) else len(lines)
    delimiter = "," if b"," in b"".join(lines[skip : skip + 1]) else " "
    table = read_table(path, skip, delimiter, COLUMNS, range(len(COLUMNS)))
    if not len(table):
        raise ScanError("the file holds no pose", file=path, remedy=f"a line is {' '.join(COLUMNS)}")
    bad = ~np.isfinite(table).all(axis=1)
    norms = np.linalg.norm(table[:, 4:], axis=1)
    checks = (
        (bad, "not a finite number"),
        (np.append(False, np.diff(table[:, 0]) <= 0.0), "the time is not later than the one before"),
        (np.abs(norms - 1.0) > _UNIT_SLACK, "qx qy qz qw is not of unit length"),
    )
    for wrong, reason in checks:
        if wrong.any():
            line_number = number_at(path, int(np.argmax(wrong)), skip)
            raise ScanError(reason, file=path, place=f"line {line_number}")
    return Trajectory(table[:, 0].copy(), table[:, 1:4].copy(), table[:, 4:] / norms[:, None], str(path))
