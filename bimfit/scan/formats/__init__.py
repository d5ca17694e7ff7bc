"""Scan files: one registry, a file a format.

A file may be larger than memory. :func:`scan_chunks` gives a scan in pieces, and whoever needs only what lies
near some places says so by ``ReadOptions.boxes``. A format takes part by ``chunks`` beside ``read``::

    def las_chunks(path: Path, options: ReadOptions) -> Iterator[PointCloud]: ...
    Format("COPC", (), read_las, looks=looks_like_copc, chunks=copc_chunks, states=las_unit),
    Format("LAS", (".las", ".laz"), read_las, write_las, (b"LASF",), chunks=las_chunks)

- It yields ``PointCloud`` (or ``LineScan``) pieces in the file's order and unit, float64, of about a million
  points, never holding more than a piece or two; what it cannot read is an error as for ``read``, at the
  latest at the end. A file without any point is an error; without any point in the boxes it is not.
- ``options.file_boxes(unit)`` are in the file's own coordinates and unit. A reader *may* leave out what lies
  outside all of them (``Boxes.of(...)``: an octree's nodes by :meth:`Boxes.meets`, points by
  :meth:`Boxes.inside` or, before they are made floats, :meth:`Boxes.find`); it need not, the caller looks
  again. None asks for everything.
- Each piece carries the viewpoint that its own points were seen from, and the notes that apply to it; equal
  notes are reported once. Pieces of one file are all clouds or all line scans. The sweeps of line-scan pieces
  are numbered for the whole file: a sweep may go on from one piece to the next.
- A reader without ``chunks`` gives one piece, whole.

``tests/scan/test_chunks.py`` holds every format to the same points in pieces as whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from bimfit.errors import ExportError, ScanError
from bimfit.files import whole_file
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats.bag import bag_chunks, is_bag_folder, read_bag
from bimfit.scan.formats.carmen import looks_like_carmen, read_carmen
from bimfit.scan.formats.copc import copc_chunks, looks_like_copc
from bimfit.scan.formats.delimited import csv_chunks, read_csv, write_csv
from bimfit.scan.formats.e57 import e57_chunks, read_e57
from bimfit.scan.formats.hokuyo_logs import looks_like_breezy, looks_like_ubh, read_breezy, read_ubh
from bimfit.scan.formats.las import las_chunks, read_las, write_las
from bimfit.scan.formats.las_crs import las_unit
from bimfit.scan.formats.npz import npz_chunks, read_npz, write_npz
from bimfit.scan.formats.options import ANY, ReadOptions, unit_name
from bimfit.scan.formats.packing import GZIP, unpacked
from bimfit.scan.formats.pcd import pcd_chunks, read_pcd, write_pcd
from bimfit.scan.formats.pictures import looks_like_sick, read_npy, read_png, read_sick, read_tiff
from bimfit.scan.formats.ply import ply_chunks, read_ply, write_ply
from bimfit.scan.formats.profiles import looks_like_profiles, read_profiles
from bimfit.scan.formats.ptx import ptx_chunks, read_ptx
from bimfit.scan.formats.summary import summary
from bimfit.scan.formats.text import first_lines
from bimfit.scan.formats.xyz import looks_like_points, read_xyz, write_xyz, xyz_chunks

Scan = LineScan | PointCloud


@dataclass(frozen=True)
class Format:
    """A kind of scan file.

    Attributes
    ----------
    name : str
    extensions : tuple of str
        Lower case, with the dot.
    read : callable
        (path, options) -> scan, in the file's own unit.
    write : callable or None
        (scan, path) -> None; None where the format is only read.
    magic : tuple of bytes
        What such files start with; empty where that says nothing.
    looks : callable or None
        Tells from a file's first bytes whether it is one, where there is no magic but a look that others
        do not have.
    beams : bool
        Whether a line scan can be written without losing its beams.
    unit : float
        Metres a unit of length where nothing else is said.
    sized : bool
        Whether the reader itself turns all lengths into metres (pictures, whose pixels have sizes).
    chunks : callable or None
        (path, options) -> pieces of the scan; None where the file is only read whole.
    states : callable or None
        Metres a unit of length that a file itself states, or None, and a note; None where no file does.
    """

    name: str
    extensions: tuple[str, ...]
    read: Callable[[Path, ReadOptions], Scan]
    write: Callable[[Scan, Path], None] | None = None
    magic: tuple[bytes, ...] = ()
    looks: Callable[[bytes], bool] | None = None
    beams: bool = False
    unit: float = 1.0
    sized: bool = False
    chunks: Callable[[Path, ReadOptions], Iterator[Scan]] | None = None
    states: Callable[[Path], tuple[float | None, str]] | None = None


def _plain(read: Callable[[Path], Scan]) -> Callable[[Path, ReadOptions], Scan]:
    """A reader that no option concerns."""
    return lambda path, options: read(path)


FORMATS: tuple[Format, ...] = (
    Format("CSV", (".csv",), _plain(read_csv), write_csv, beams=True, chunks=csv_chunks),
    Format("NPZ", (".npz",), _plain(read_npz), write_npz, (b"PK\x03\x04",), beams=True, chunks=npz_chunks),
    Format("PLY", (".ply",), _plain(read_ply), write_ply, (b"ply\n", b"ply\r\n"), chunks=ply_chunks),
    Format(
        "PCD",
        (".pcd",),
        _plain(read_pcd),
        write_pcd,
        (b"# .PCD", b"VERSION 0.7", b"VERSION .7"),
        chunks=pcd_chunks,
    ),
    Format("COPC", (), read_las, looks=looks_like_copc, chunks=copc_chunks, states=las_unit),
    Format("LAS", (".las", ".laz"), read_las, write_las, (b"LASF",), chunks=las_chunks, states=las_unit),
    Format("E57", (".e57",), read_e57, None, (b"ASTM-E57",), chunks=e57_chunks),
    Format(
        "ROS bag",
        (".bag", ".mcap", ".db3"),
        read_bag,
        None,
        (b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\0"),
        chunks=bag_chunks,
    ),
    Format("PTX", (".ptx",), _plain(read_ptx), chunks=ptx_chunks),
    Format("CARMEN log", (".clf",), _plain(read_carmen), looks=looks_like_carmen),
    Format("UBH", (".ubh",), _plain(read_ubh), looks=looks_like_ubh, unit=1e-3),
    Format("BreezySLAM", (".dat",), _plain(read_breezy), looks=looks_like_breezy, unit=1e-3),
    Format("SICK height map", (".json",), read_sick, looks=looks_like_sick, sized=True, unit=1e-3),
    Format("PNG height map", (".png",), read_png, None, (b"\x89PNG\r\n\x1a\n",), sized=True),
    Format(
        "TIFF height map",
        (".tif", ".tiff"),
        read_tiff,
        None,
        (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
        sized=True,
    ),
    Format("array", (".npy",), read_npy, None, (b"\x93NUMPY",), sized=True),
    Format("profiles", (), read_profiles, looks=looks_like_profiles, sized=True, unit=1e-3),
    Format("XYZ", (".xyz", ".txt", ".pts", ".asc"), _plain(read_xyz), write_xyz, chunks=xyz_chunks),
)


def read_scan(path: str | Path, unit: float | None = None, options: ReadOptions = ANY) -> Scan:
    """Read a line scan or a point cloud, whichever the file holds; its last note says what was read.

    Parameters
    ----------
    path : str or Path
        The content names the format where it can (PLY, PCD, NPZ), else the extension, else whether it looks
        like rows of numbers. A file packed by gzip is unpacked on the way.
    unit : float, optional
        Metres a unit of length of the file; goes before that of ``options``.
    options : ReadOptions
        What else the file may not say.

    Raises
    ------
    ScanError
        In one clear line, when the file cannot be read or holds no scan.
    """
    if unit is not None:
        options = replace(options, unit=unit)
    with _opened(Path(path)) as (form, inner):
        options, why = _with_stated_unit(form, inner, options, Path(path))
        scan = _in_metres(form.read(inner, options), form, options, Path(path))
    said = summary(scan, form.name, options.unit or form.unit)
    return replace(scan, notes=(*scan.notes, *why, said))


def scan_chunks(path: str | Path, options: ReadOptions = ANY) -> Iterator[Scan]:
    """Read a scan in pieces, in the file's order, never holding more than a few of them.

    Every piece's last note names the format and its unit.

    Parameters
    ----------
    path : str or Path
    options : ReadOptions
        Points outside ``options.boxes`` may be left out, so that a file with an index is not read whole.

    Raises
    ------
    ScanError
        In one clear line, while the pieces are drawn.
    """
    with _opened(Path(path)) as (form, inner):
        read = form.chunks or (lambda path, options: iter((form.read(path, options),)))
        options, why = _with_stated_unit(form, inner, options, Path(path))
        said = f"{form.name}, in {unit_name(options.unit or form.unit)}"
        for piece in read(inner, options):
            scan = _in_metres(piece, form, options, Path(path))
            yield replace(scan, notes=(*scan.notes, *why, said))


def unit_taken(path: str | Path, options: ReadOptions = ANY) -> float:
    """Metres a unit of length that reading a scan takes: the one said, stated by the file, or usual."""
    with _opened(Path(path)) as (form, inner):
        return _with_stated_unit(form, inner, options, Path(path))[0].unit or form.unit


def _with_stated_unit(
    form: Format, inner: Path, options: ReadOptions, source: Path
) -> tuple[ReadOptions, tuple[str, ...]]:
    """The options with the unit that the file states, where the user says none, and a note of it."""
    if options.unit is not None or form.states is None:
        return options, ()
    try:
        unit, note = form.states(inner)
    except ScanError as error:
        raise ScanError(error.message, file=source, place=error.place, remedy=error.remedy) from error
    if unit is None or unit == form.unit:
        return options, (note,) if note else ()
    return replace(options, unit=unit), (f"its coordinate system is in {unit_name(unit)}",)


@contextmanager
def _opened(source: Path) -> Iterator[tuple[Format, Path]]:
    """A file's format, and where it lies unpacked; errors name the file that the user named."""
    if source.is_dir():
        if not is_bag_folder(source):
            raise ScanError(
                "is a folder", file=source, remedy="name a scan file, or the folder of a ROS 2 bag"
            )
        yield next(form for form in FORMATS if form.chunks is bag_chunks), source
        return
    head = first_lines(source)
    if not head.startswith(GZIP):
        yield format_of(source, head), source
        return
    with unpacked(source) as inner:
        try:
            yield format_of(inner, first_lines(inner)), inner
        except ScanError as error:
            raise ScanError(error.message, file=source, place=error.place, remedy=error.remedy) from error


def _in_metres(scan: Scan, form: Format, options: ReadOptions, source: Path) -> Scan:
    unit = options.unit or form.unit
    if unit != 1.0 and not form.sized:
        scan = scaled(scan, unit)
    return replace(scan, source=str(source))


def write_scan(scan: Scan, path: str | Path) -> None:
    """Write a scan, whole or not at all, in the format that the extension names.

    Raises
    ------
    ExportError
        When the extension is unknown or cannot hold what the scan holds, or the file cannot be written.
    """
    target = Path(path)
    able = [f for f in FORMATS if f.write is not None and (f.beams or isinstance(scan, PointCloud))]
    for form in able:
        if target.suffix.lower() in form.extensions and form.write is not None:
            with whole_file(target) as part:
                form.write(scan, part)
            return
    kind = "a point cloud" if isinstance(scan, PointCloud) else "a line scan"
    names = ", ".join(extension for form in able for extension in form.extensions)
    raise ExportError(
        f"{kind} cannot be written as {target.suffix or 'a file without extension'}",
        file=target,
        remedy=f"use {names}",
    )


def scaled(scan: Scan, factor: float) -> Scan:
    """The scan with all lengths times ``factor``."""
    if isinstance(scan, PointCloud):
        eye = scan.viewpoint
        return replace(scan, points=scan.points * factor, viewpoint=None if eye is None else eye * factor)
    return replace(scan, origins=scan.origins * factor, ranges=scan.ranges * factor)


def format_of(path: Path, head: bytes) -> Format:
    """The format of a file with such first bytes; what a file says of itself beats its name.

    Raises
    ------
    ScanError
        When it is none that is known.
    """
    for form in FORMATS:
        if form.looks is not None and form.looks(head):
            return form
    for form in FORMATS:
        if any(head.startswith(magic) for magic in form.magic):
            return form
    suffix = path.suffix.lower()
    for form in FORMATS:
        if suffix in form.extensions:
            return form
    if looks_like_points(head):
        return next(form for form in FORMATS if form.name == "XYZ")
    known = ", ".join(extension for form in FORMATS for extension in form.extensions)
    raise ScanError(
        f"unknown kind of scan file {suffix or '(no extension)'}", file=path, remedy=f"known are {known}"
    )
