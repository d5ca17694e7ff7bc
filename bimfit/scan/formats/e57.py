"""E57 through libE57, in pieces.

Points are read as float64, however the file stores them, and their validity is heeded: pye57's own
``read_scan`` needs all memory at once, takes intensities and row numbers into narrower types, and reads a
pose by the order of its numbers instead of their names. Points that are exactly at the scanner were never
measured and are left out, flagged or not.

Scans that know rows and columns become beams where these are sweeps as seen from the scanner; else points
that know from where they were seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array, transform_points
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud, joined_clouds, usable
from bimfit.scan.formats.options import ReadOptions
from bimfit.scan.formats.organised import PLANAR, planarity, swept
from bimfit.scan.formats.packed import COARSE

if TYPE_CHECKING:
    from types import ModuleType

PIECE = 500_000
_MOST_CELLS = 64_000_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_LINES = ("columnIndex", "rowIndex")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_SAMPLE_LINES = 60


@dataclass(frozen=True)
class _Scan:
    """One scan of the file, before its points are read.

    ``T`` carries its coordinates to the file's; ``posed`` tells whether the file says so. ``major`` names the
    index that grows along the file where its lines are sweeps, else it is empty.
    """

    node: Any
    name: str
    count: int
    fields: tuple[str, ...]
    T: Array
    posed: bool
    step: float
    major: str = ""

    @property
    def spherical(self) -> bool:
        return not set(_CARTESIAN) <= set(self.fields)

    @property
    def minor(self) -> str:
        """The index along a sweep."""
        return _LINES[1] if self.major == _LINES[0] else _LINES[0]

    @property
    def eye(self) -> Array | None:
        """Where the scanner stood, shape (3,), where the file says so.

        A pose that moves nothing is what writers put into registered clouds, and says nothing.
        """
        return self.T[:3, 3].copy() if self.posed and not np.array_equal(self.T, np.eye(4)) else None


def read_e57(path: Path, options: ReadOptions) -> LineScan | PointCloud:
    """Read every scan of an E57 file in the file's coordinates.

    Raises
    ------
    ScanError
        When it is no such file, is cut short or damaged (all sums are checked), holds no point, or pye57 is
        not installed.
    """
    pieces = list(e57_chunks(path, replace(options, boxes=None)))
    notes = tuple(dict.fromkeys(note for piece in pieces for note in piece.notes))
    beams = [piece for piece in pieces if isinstance(piece, LineScan)]
    if beams:
        return LineScan(
            np.concatenate([piece.scan for piece in beams]),
            np.concatenate([piece.origins for piece in beams]),
            np.concatenate([piece.directions for piece in beams]),
            np.concatenate([piece.ranges for piece in beams]),
            str(path),
            notes,
        )
    return joined_clouds([piece for piece in pieces if isinstance(piece, PointCloud)])


def e57_chunks(path: Path, options: ReadOptions) -> Iterator[LineScan | PointCloud]:
    """Read every scan of an E57 file in pieces, points outside the boxes left out.

    Raises
    ------
    ScanError
        As :func:`read_e57` does, at the latest after the last piece.
    """
    lib = _library(path)
    boxes = options.file_boxes(1.0)
    wanted = None if boxes is None else Boxes.of(boxes)
    with _named_errors(path, lib), _image(lib, path) as image:
        scans = _scans(path, lib, image)
        placed = [_with_sweeps(lib, image, scan) for scan in scans]
        as_beams = bool(placed) and all(scan.major for scan in placed)
        seen = first = 0
        for scan in placed:
            if as_beams:
                for piece, last in _sweep_pieces(path, lib, image, scan, first):
                    seen += int(piece.returned.sum())
                    first = last
                    yield piece
            else:
                for cloud in _cloud_pieces(path, lib, image, scan):
                    seen += len(cloud)
                    yield cloud if wanted is None else _kept(cloud, wanted.inside(cloud.points))
    if not seen:
        raise ScanError("the file holds no point", file=path)


# -- the file ------------------------------------------------------------------------------------------


def _library(path: Path) -> ModuleType:
    try:
        from pye57 import libe57
    except ImportError as error:
        raise ScanError(
            "reading E57 needs the package pye57", file=path, remedy='pip install "bimfit[e57]"'
        ) from error
    return libe57  # type: ignore[no-any-return]


@contextmanager
def _image(lib: ModuleType, path: Path) -> Iterator[Any]:
    image = lib.ImageFile(str(path), "r")
    try:
        yield image
    finally:
        image.close()


@contextmanager
def _named_errors(path: Path, lib: ModuleType) -> Iterator[None]:
    """Turn what libE57 raises on damaged files into one clear line."""
    try:
        yield
    except lib.E57Exception as error:
        reason = str(error).strip().split("\n")[0][:200] or "it makes no sense"
        raise ScanError(f"not an E57 file, or damaged: {reason}", file=path) from error
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror or error}", file=path) from error
    except (ValueError, TypeError, RuntimeError, OverflowError, MemoryError, AttributeError) as error:
        raise ScanError(f"not an E57 file, or damaged: {error}", file=path) from error


def _scans(path: Path, lib: ModuleType, image: Any) -> list[_Scan]:
    root = image.root()
    if not root.isDefined("data3D"):
        raise ScanError("the file holds no scan", file=path)
    out = []
    nodes = root["data3D"]
    for k in range(nodes.childCount()):
        node = nodes[k]
        if not node.isDefined("points"):
            continue
        points = node["points"]
        prototype = lib.StructureNode(points.prototype())
        fields = tuple(prototype[i].elementName() for i in range(prototype.childCount()))
        if not (set(_CARTESIAN) <= set(fields) or set(_SPHERICAL) <= set(fields)):
            raise ScanError("points without coordinates", file=path, place=f"scan {k + 1}")
        T, posed = _pose(path, node, k)
        count = int(points.childCount())
        out.append(_Scan(points, f"scan {k + 1}", count, fields, T, posed, _step(lib, prototype)))
    return out


def _pose(path: Path, node: Any, number: int) -> tuple[Array, bool]:
    """T_file_scan, and whether the file has it."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    if not node.isDefined("pose"):
        return T, False
    pose = node["pose"]
    if pose.isDefined("rotation"):
        quaternion = np.array([pose["rotation"][name].value() for name in "xyzw"], float)
        size = float(np.linalg.norm(quaternion))
        if not 0.9 < size < 1.1:
            raise ScanError("the scanner's rotation is none", file=path, place=f"scan {number + 1}")
        T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    if pose.isDefined("translation"):
        T[:3, 3] = [pose["translation"][name].value() for name in "xyz"]
        if not usable(T[None, :3, 3])[0]:
            raise ScanError("the scanner's place is in no world", file=path, place=f"scan {number + 1}")
    return T, True


def _step(lib: ModuleType, prototype: Any) -> float:
    """Coarsest step of the stored coordinates, in m; 0 where they are float64 or not Cartesian."""
    steps = [0.0]
    for name in _CARTESIAN:
        if not prototype.isDefined(name):
            continue
        node = prototype[name]
        if isinstance(node, lib.ScaledIntegerNode):
            steps.append(abs(float(node.scale())))
        elif isinstance(node, lib.FloatNode) and node.precision() == lib.FloatPrecision.E57_SINGLE:
            steps.append(-1.0)  # depends on how large the coordinates are
        elif isinstance(node, lib.IntegerNode):
            steps.append(1.0)
    return -1.0 if min(steps) < 0.0 else max(steps)


# -- pieces ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Piece:
    """Points in the scan's own coordinates, NaN where nothing was measured; further columns where known."""

    points: Array
    columns: dict[str, NDArray[Any]]


def _pieces(path: Path, lib: ModuleType, image: Any, scan: _Scan, size: int = 0) -> Iterator[_Piece]:
    own = _SPHERICAL if scan.spherical else _CARTESIAN
    invalid = "sphericalInvalidState" if scan.spherical else "cartesianInvalidState"
    names = [*own, *(n for n in (invalid, *_LINES, "intensity", *_COLORS) if n in scan.fields)]
    size = size or PIECE
    # a longlong: what NumPy calls int64 on Linux is a C long, of which pye57 fills 32 bits
    whole = {invalid, *_LINES, *_COLORS}
    room: dict[str, NDArray[Any]] = {
        name: np.zeros(size, np.longlong if name in whole else np.float64) for name in names
    }
    buffers = lib.VectorSourceDestBuffer()
    for name in names:
        buffers.append(lib.SourceDestBuffer(image, name, room[name], size, True, True))
    reader = scan.node.reader(buffers)
    seen = 0
    try:
        while count := int(reader.read()):
            seen += count
            columns = {name: values[:count].copy() for name, values in room.items()}
            points: Array = np.stack([columns.pop(name) for name in own], axis=1)
            if scan.spherical:
                points = _cartesian(points)
            nothing = ~usable(points) | (points == 0.0).all(axis=1)
            if invalid in columns:
                nothing |= columns.pop(invalid) != 0
            points[nothing] = np.nan
            yield _Piece(points, columns)
    finally:
        reader.close()
    if seen < scan.count:
        raise ScanError(f"cut short: {seen} of {scan.count} points", file=path, place=scan.name)


def _cartesian(spherical: Array) -> Array:
    """Range, azimuth and elevation (n, 3) to x, y, z (E57 standard, 8.4.4)."""
    r, azimuth, elevation = spherical.T
    with np.errstate(invalid="ignore", over="ignore"):
        flat = r * np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), r * np.sin(elevation)], axis=1)


def _cloud_pieces(path: Path, lib: ModuleType, image: Any, scan: _Scan) -> Iterator[PointCloud]:
    for piece in _pieces(path, lib, image, scan):
        keep = np.isfinite(piece.points[:, 0])
        points = piece.points[keep]
        notes = _precision(scan, points)
        lost = "points that were not measured are left out"
        bright = piece.columns.get("intensity")
        yield PointCloud(
            transform_points(scan.T, points) if scan.posed else points,
            scan.eye,
            None,
            _colors(piece.columns, keep),
            None if bright is None else bright[keep],
            str(path),
            notes if keep.all() else (*notes, lost),
        )


def _colors(columns: dict[str, NDArray[Any]], keep: NDArray[np.bool_]) -> NDArray[np.uint8] | None:
    if not all(name in columns for name in _COLORS):
        return None
    values = np.stack([columns[name][keep] for name in _COLORS], axis=1)
    if values.size and values.max() > 255:  # 16 bits a channel
        values = values >> 8
    return np.asarray(np.clip(values, 0, 255), np.uint8)


def _precision(scan: _Scan, points: Array) -> tuple[str, ...]:
    """A note where the file cannot hold its coordinates to 0.1 mm."""
    if scan.step == 0.0 or not len(points):
        return ()
    if scan.step < 0.0:
        step = float(np.spacing(np.float32(np.abs(points).max())))
        if step > 2 * COARSE:
            return (f"coordinates are stored in single precision, in steps of {step:.3g} m so far out",)
        return ()
    return (f"coordinates are stored in steps of {scan.step:g} m",) if scan.step > 2 * COARSE else ()


# -- sweeps ----------------------------------------------------------------------------------------------


def _with_sweeps(lib: ModuleType, image: Any, scan: _Scan) -> _Scan:
    """Find out whether the scan's lines are sweeps, from its first piece."""
    if not set(_LINES) <= set(scan.fields) or scan.count == 0:
        return scan
    piece = next(_pieces(Path(scan.name), lib, image, replace(scan, count=0)), None)
    if piece is None:
        return scan
    for major in _LINES:
        lines = piece.columns[major]
        minor = piece.columns[_LINES[1] if major == _LINES[0] else _LINES[0]]
        if (np.diff(lines) < 0).any() or lines[0] == lines[-1] or min(lines.min(), minor.min()) < 0:
            continue
        whole = np.unique(lines)[: -1 if scan.count > len(lines) else None]
        chosen = whole[np.unique(np.linspace(0, len(whole) - 1, _SAMPLE_LINES).astype(int))]
        use = np.isin(lines, chosen)
        row = np.searchsorted(chosen, lines[use])
        grid = _grid(row, minor[use], piece.points[use])
        if grid is not None and planarity(grid, np.zeros(3)) <= PLANAR:
            return replace(scan, major=major)
    return scan


def _grid(line: NDArray[Any], place: NDArray[Any], points: Array) -> Array | None:
    """Points by line and place, shape (lines, places, 3), NaN elsewhere; None where that is out of hand."""
    shape = (int(line.max()) + 1, int(place.max()) + 1)
    if shape[0] * shape[1] > _MOST_CELLS:
        return None
    out = np.full((*shape, 3), np.nan)
    out[line, place] = points
    return out


def _sweep_pieces(
    path: Path, lib: ModuleType, image: Any, scan: _Scan, first: int
) -> Iterator[tuple[LineScan, int]]:
    """Whole sweeps at a time, and the number of the next."""
    kept = _Piece(np.zeros((0, 3)), {name: np.zeros(0, np.int64) for name in _LINES})
    for piece in _pieces(path, lib, image, scan):
        both = _Piece(
            np.concatenate([kept.points, piece.points]),
            {name: np.concatenate([kept.columns[name], piece.columns[name]]) for name in _LINES},
        )
        lines = both.columns[scan.major]
        if (np.diff(lines) < 0).any() or both.columns[scan.minor].min() < 0:
            raise ScanError(f"its {scan.major} goes back and forth", file=path, place=scan.name)
        cut = int(np.searchsorted(lines, lines[-1]))
        if cut:
            made, first = _sweeps(path, scan, both, slice(0, cut), first)
            yield made, first
        kept = _Piece(both.points[cut:], {name: both.columns[name][cut:] for name in _LINES})
    if len(kept.points):
        yield _sweeps(path, scan, kept, slice(None), first)


def _sweeps(path: Path, scan: _Scan, piece: _Piece, part: slice, first: int) -> tuple[LineScan, int]:
    points = piece.points[part]
    _, line = np.unique(piece.columns[scan.major][part], return_inverse=True)
    grid = _grid(line.reshape(-1), piece.columns[scan.minor][part], points)
    if grid is None:
        raise ScanError("damaged: its rows and columns make no grid", file=path, place=scan.name)
    beams, unknown = swept(grid, np.zeros(3), str(path), first)
    notes = [f"structured: its {scan.major.removesuffix('Index')}s are sweeps as seen from the scanner"]
    if unknown:
        notes.append("empty places at the ends of sweeps are left out")
    notes += _precision(scan, points[np.isfinite(points[:, 0])])
    return replace(beams.transformed(scan.T), notes=tuple(notes)), first + len(grid)


# -- whole -----------------------------------------------------------------------------------------------


def _kept(cloud: PointCloud, keep: NDArray[np.bool_]) -> PointCloud:
    return replace(
        cloud,
        points=cloud.points[keep],
        colors=None if cloud.colors is None else cloud.colors[keep],
        intensity=None if cloud.intensity is None else cloud.intensity[keep],
    )
