"""Look-up tables of a component in space: its blurred visible surface and majorants of it.

The field is a lattice of exp(-d^2 / 2 blur^2) (cut off and lowered to zero at 2.5 blurs), read
trilinearly. For each of some radii r a sparse table holds, a block of the lattice each, an affine function
that is nowhere under the field within the block widened by r (METHOD, section 9).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.errors import ConfigError, ModelError
from bimfit.files import whole_file
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array
from bimfit.registration import _kernels_3d as kernels
from bimfit.registration.surface_3d import Surface, visible_surface

RADII = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Radius classes, lattice cells. Finer ones gain no evaluations, and cost most of memory and building."""
BLOCKS = (1, 1, 2, 2, 4, 4, 8, 8, 16)
"""Block sides of the classes, lattice cells."""
PER_CELL = 8.0
REACH = 2.5
"""Blurs after which the field is zero."""
_MAX_NODES = 24_000_000
_VERSION = 1


@dataclass(frozen=True)
class Tables3D:
    """Majorants of one field, as the kernels take them; lengths in cells.

    Attributes
    ----------
    bricks : ndarray of int32
        For every class in turn the number of each brick of 4 x 4 x 4 blocks; 0 where the field is zero.
    records : ndarray of int16, shape (64 bricks, 4)
        (A, gx, gy, gz) a block.
    shapes, starts : ndarray
        Bricks an axis, and where a class begins in ``bricks``.
    pads : ndarray
        Offset of a class's first block under the field's first node.
    g_scale : float
        Integer steps of a slope of 1 a cell.
    """

    bricks: NDArray[np.int32]
    records: NDArray[np.int16]
    shapes: NDArray[np.int64]
    starts: NDArray[np.int64]
    pads: Array
    g_scale: float

    @property
    def packed(self) -> tuple[Any, ...]:
        """The kernels' argument."""
        radii = np.array(RADII)
        steps = np.arange(int(RADII[-1] * PER_CELL) + 2) / PER_CELL
        choose = np.minimum(np.searchsorted(radii, steps), len(radii) - 1).astype(np.int64)
        blocks = np.array(BLOCKS, float)
        return (
            radii,
            choose,
            PER_CELL,
            blocks,
            1.0 / blocks,  # exact: sides are powers of two
            self.pads,
            self.shapes,
            self.starts,
            self.bricks,
            self.records,
            self.g_scale,
        )


@dataclass(frozen=True)
class Target3D:
    """A component (or several) ready to be searched for in a cloud.

    Attributes
    ----------
    surface : Surface
        Samples of the visible surface, m.
    origin : ndarray, shape (3,)
        The field's first node in the model's frame, m.
    spacing, blur : float
        Of the lattice, and standard deviation of the field, m.
    field : ndarray of float32, shape (nx, ny, nz)
    tables : Tables3D
    """

    surface: Surface
    origin: Array
    spacing: float
    blur: float
    field: NDArray[np.float32]
    tables: Tables3D

    @classmethod
    def of(
        cls,
        shape: TriangleMesh | Surface | ArrayLike,
        blur: float = 0.006,
        *,
        viewpoint: ArrayLike | None = None,
        spacing: float | None = None,
        max_bytes: int = 128 * 2**20,
        cache: str | Path | None = None,
    ) -> Target3D:
        """Build the tables of a mesh, of surface samples, or of a cloud that stands for a model.

        Parameters
        ----------
        shape : TriangleMesh, Surface or array_like, shape (n, 3)
            A bare cloud needs points no farther apart than about two lattice cells.
        blur : float
            About twice the sensor's sigma, m; for components that may have moved by themselves more
            (METHOD 2c).
        viewpoint : array_like, shape (3,), optional
            The sensor in the model's frame: only what it sees of a mesh is kept.
        spacing : float, optional
            Of the lattice; default a third of the blur, coarser where that would take too much memory.
        max_bytes : int
            What field and tables may take, about, when ``spacing`` is not given. A large component is
            better cut down to what the scan shows of it.
        cache : path, optional
            A folder in which built tables are kept and found again.

        Raises
        ------
        ConfigError
            When blur or spacing is not positive.
        ModelError
            When nothing can be seen, or the lattice asked for is too large.
        """
        if not (np.isfinite(blur) and blur > 0.0 and (spacing is None or spacing > 0.0)):
            raise ConfigError(f"blur and spacing must be positive, got {blur} and {spacing}")
        corners = _corners(shape)
        cell = spacing or _affordable(corners, _area(shape, viewpoint), blur, max_bytes)
        if _nodes(corners, blur, cell) > _MAX_NODES:
            raise ModelError(
                f"a lattice of {_nodes(corners, blur, cell):.0f} nodes is too large",
                remedy="give a larger spacing or blur, or a part of the component",
            )
        surface = _surface_of(shape, cell, viewpoint)
        where = None if cache is None else Path(cache) / f"target3d-{_key(surface, blur, cell)}.npz"
        if where is not None and where.exists():
            loaded = _load(where, surface)
            if loaded is not None:
                return loaded
        built = _build(surface, blur, cell)
        if where is not None:
            _save(where, built)
        return built

    @property
    def nbytes(self) -> int:
        """Memory of field and tables, bytes."""
        return int(self.field.nbytes + self.tables.bricks.nbytes + self.tables.records.nbytes)


def affordable_spacing(surface: Surface, blur: float, max_bytes: int = 128 * 2**20) -> float:
    """The lattice's spacing (m) that :meth:`Target3D.of` takes for samples of a surface by itself."""
    return _affordable(_corners(surface), _area(surface, None), blur, max_bytes)


def _corners(shape: TriangleMesh | Surface | ArrayLike) -> Array:
    if isinstance(shape, TriangleMesh):
        if not len(shape.faces):
            raise ModelError("the component has no surface", remedy="check its geometry")
        return shape.bounds
    points = shape.points if isinstance(shape, Surface) else np.asarray(shape, float)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.all(np.isfinite(points)):
        raise ModelError(f"a model's points are an (n, 3) array of finite numbers, got shape {points.shape}")
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _nodes(corners: Array, blur: float, cell: float) -> float:
    return float(np.prod((corners[1] - corners[0] + 2.0 * REACH * blur) / cell + 5.0))


def _area(shape: TriangleMesh | Surface | ArrayLike, viewpoint: ArrayLike | None) -> float:
    """Visible area, m^2, from a few thousand samples; 0 for a bare cloud."""
    if isinstance(shape, Surface):
        return len(shape) * shape.spacing**2
    if not isinstance(shape, TriangleMesh):
        return 0.0
    whole = float(np.linalg.norm(shape.face_vectors, axis=1).sum())
    spacing = max(np.sqrt(whole / 5000.0), 1e-6)
    return float(len(visible_surface(shape, spacing, viewpoint)) * spacing**2)


def _affordable(corners: Array, area: float, blur: float, max_bytes: int) -> float:
    """A third of the blur, or the least coarser spacing that the memory allows."""
    cell = blur / 3.0
    while True:
        nodes = _nodes(corners, blur, cell)
        # Two records of 8 bytes a cell of the layer around the surface (the finest classes), and a little.
        layer = area / cell**2 * (2.0 * REACH * blur / cell + 3.0)
        if nodes <= _MAX_NODES and 4.0 * nodes + 36.0 * layer <= max_bytes:
            return cell
        cell *= 1.05


def _surface_of(
    shape: TriangleMesh | Surface | ArrayLike, cell: float, viewpoint: ArrayLike | None
) -> Surface:
    if isinstance(shape, Surface):
        return shape
    if isinstance(shape, TriangleMesh):
        return visible_surface(shape, 2.0 * cell, viewpoint)
    from bimfit.registration.candidates_3d import plane_normals

    points = np.asarray(shape, float)
    normals, _ = plane_normals(points, points, 4.0 * cell)
    return Surface(points, normals, 2.0 * cell, unsigned=True)


def _build(surface: Surface, blur: float, cell: float) -> Target3D:
    reach = REACH * blur / cell
    pad = np.ceil(reach) + 2.0
    low = surface.points.min(axis=0)
    origin = low - pad * cell
    shape = np.ceil((surface.points.max(axis=0) - low) / cell).astype(int) + int(2 * pad) + 1
    field = np.zeros(tuple(shape), np.float32)
    half = surface.spacing / cell / np.sqrt(2.0)
    points = np.ascontiguousarray((surface.points - origin) / cell)
    kernels.splat(points, np.ascontiguousarray(surface.normals), half, blur / cell, reach, field)
    for axis in range(3):
        # Beyond the last node the field reads as zero: the border must be zero for it to be continuous.
        np.moveaxis(field, axis, 0)[[0, -1]] = 0.0
    return Target3D(surface, origin, cell, blur, field, _tables(field, blur / cell))


def _tables(field: NDArray[np.float32], sigma: float) -> Tables3D:
    # No slope of the field exceeds exp(-1/2) / sigma; least-squares slopes stay under twice that.
    g_scale = 32767.0 * sigma / 1.3
    layout = []
    count = 1
    for radius, block in zip(RADII, BLOCKS, strict=True):
        pad = float(np.ceil(radius) + block + 1)
        side = block * kernels.BRICK
        shape = np.ceil((np.array(field.shape) + 2.0 * pad) / side).astype(np.int64)
        index = np.zeros(tuple(shape), np.int32)
        kernels.mark_bricks(field, radius, block, pad, index)
        filled = index > 0
        index[filled] = np.arange(count, count + int(filled.sum()), dtype=np.int32)
        count += int(filled.sum())
        layout.append((radius, block, pad, index))
    records = np.zeros((count * kernels.BRICK**3, 4), np.int16)
    for radius, block, pad, index in layout:
        kernels.fill_bricks(field, radius, block, pad, index, g_scale, records)
    sizes = [index.size for *_, index in layout]
    return Tables3D(
        bricks=np.concatenate([index.ravel() for *_, index in layout]),
        records=records,
        shapes=np.array([index.shape for *_, index in layout], np.int64),
        starts=np.cumsum([0, *sizes[:-1]]).astype(np.int64),
        pads=np.array([pad for _, _, pad, _ in layout]),
        g_scale=g_scale,
    )


def _key(surface: Surface, blur: float, cell: float) -> str:
    digest = hashlib.sha256(repr((_VERSION, RADII, BLOCKS, blur, cell, surface.spacing)).encode())
    digest.update(np.ascontiguousarray(surface.points).tobytes())
    digest.update(np.ascontiguousarray(surface.normals).tobytes())
    return digest.hexdigest()[:24]


def _save(path: Path, target: Target3D) -> None:
    tables = target.tables
    with whole_file(path) as part:
        np.savez(
            part,
            origin=target.origin,
            numbers=np.array([target.spacing, target.blur, tables.g_scale]),
            field=target.field,
            bricks=tables.bricks,
            records=tables.records,
            shapes=tables.shapes,
            starts=tables.starts,
            pads=tables.pads,
        )


def _load(path: Path, surface: Surface) -> Target3D | None:
    """Tables kept by an earlier run; None when the file is damaged, so that they are built again."""
    try:
        with np.load(path, allow_pickle=False) as data:
            spacing, blur, g_scale = (float(x) for x in data["numbers"])
            tables = Tables3D(
                data["bricks"], data["records"], data["shapes"], data["starts"], data["pads"], g_scale
            )
            return Target3D(surface, data["origin"], spacing, blur, data["field"], tables)
    except (OSError, ValueError, KeyError, EOFError):
        return None
