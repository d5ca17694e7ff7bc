"""ROS 1 bags, ROS 2 bags and MCAP through ``rosbags``, without ROS.

A LaserScan is a sweep of beams, each at its own time; a PointCloud2 gives points. Both are carried through tf
and tf_static into the frame at the top of the sensor's chain, or the one that is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud, joined_clouds
from bimfit.scan.formats.frames import Edge, Frames, Sample, chained
from bimfit.scan.formats.messages import beams_of_message, points_of_message
from bimfit.scan.formats.options import ReadOptions

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

PIECE = 500_000
_SCAN, _CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return (path / "metadata.yaml").is_file()


def read_bag(path: Path, options: ReadOptions) -> LineScan | PointCloud:
    """Read the LaserScan or PointCloud2 messages of one topic.

    Raises
    ------
    ScanError
        When the bag is cut short or damaged, has no such topic or several, nothing came back, or rosbags is
        not installed.
    """
    pieces = list(bag_chunks(path, replace(options, boxes=None)))
    beams = [piece for piece in pieces if isinstance(piece, LineScan)]
    if beams:
        notes = dict.fromkeys(note for piece in beams for note in piece.notes)
        return replace(_joined(beams), notes=tuple(notes))
    return joined_clouds([piece for piece in pieces if isinstance(piece, PointCloud)])


def bag_chunks(path: Path, options: ReadOptions) -> Iterator[LineScan | PointCloud]:
    """Read the LaserScan or PointCloud2 messages of one topic in pieces.

    Raises
    ------
    ScanError
        As :func:`read_bag` does, at the latest after the last piece.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ScanError(
            "reading ROS bags needs the package rosbags", file=path, remedy='pip install "bimfit[ros]"'
        ) from error
    with _named_errors(path), AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        topic = _topic(path, reader.connections, options.topic)
        yield from _Reading(path, reader, topic, options).pieces()


@dataclass
class _Reading:
    """One topic's messages on their way to pieces."""

    path: Path
    reader: AnyReader
    topic: str
    options: ReadOptions
    lost: int = 0

    def pieces(self) -> Iterator[LineScan | PointCloud]:
        """Pieces of about half a million beams or points."""
        frames = Frames(*self._transforms())
        own = [c for c in self.reader.connections if c.topic == self.topic]
        chains: dict[str, list[Edge]] = {}
        held: list[LineScan | PointCloud] = []
        size = returned = number = 0
        notes: tuple[str, ...] = (f"topic {self.topic}",)
        for connection, stamp, raw in self.reader.messages(connections=own):
            message: Any = self.reader.deserialize(raw, connection.msgtype)
            frame = str(message.header.frame_id).lstrip("/")
            if frame not in chains:
                chains[frame] = self._chain(frames, frame)
                notes = (*notes, _placed(frame, chains[frame]))
            piece = self._piece(message, connection.msgtype, _time(message, stamp), chains[frame], number)
            number += 1
            if piece is None:
                self.lost += 1
                continue
            held.append(piece)
            size += len(piece)
            returned += int(piece.returned.any()) if isinstance(piece, LineScan) else len(piece)
            if size >= PIECE:
                yield from self._grouped(held, notes)
                held, size = [], 0
        if self.lost:
            notes = (*notes, f"{self.lost} messages at times without transforms left out")
        if held:
            yield from self._grouped(held, notes)
        if not returned:
            at = f"; its {self.lost} messages are all at times without transforms" if self.lost else ""
            raise ScanError(f"topic {self.topic} holds no return{at}", file=self.path)

    def _piece(
        self, message: Any, kind: str, stamp: int, chain: list[Edge], number: int
    ) -> LineScan | PointCloud | None:
        """One message in the base frame; None where the transforms do not reach its time."""
        if kind == _SCAN:
            scan, beam_times = beams_of_message(message, stamp, number)
            T, known = chained(chain, beam_times)
            if not known.all():
                return None
            return replace(
                scan,
                origins=T[:, :3, 3].copy(),
                directions=np.einsum("nij,nj->ni", T[:, :3, :3], scan.directions),
                source=str(self.path),
            )
        cloud, times = points_of_message(self.path, message, stamp)
        T, known = chained(chain, np.array([stamp]) if times is None else np.append(times, stamp))
        if not known.all():
            return None
        if times is None:
            points = cloud.points @ T[0, :3, :3].T + T[0, :3, 3]
        else:  # points that know their times, carried by where the sensor was at each
            points = np.einsum("nij,nj->ni", T[:-1, :3, :3], cloud.points) + T[:-1, :3, 3]
        return replace(cloud, points=points, viewpoint=T[-1, :3, 3].copy(), source=str(self.path))

    def _grouped(
        self, held: list[LineScan | PointCloud], notes: tuple[str, ...]
    ) -> Iterator[LineScan | PointCloud]:
        """Beams together; points by where they were seen from."""
        beams = [piece for piece in held if isinstance(piece, LineScan)]
        if beams:
            yield replace(_joined(beams), notes=notes)
            return
        for piece in held:
            if isinstance(piece, PointCloud):
                yield replace(piece, notes=(*notes, *piece.notes))

    def _chain(self, frames: Frames, frame: str) -> list[Edge]:
        base = self.options.frame.lstrip("/")
        chain = frames.chain(frame, base)
        if chain is None:
            known = ", ".join(frames.names[:20]) or "none"
            raise ScanError(
                f"frame {frame} is not under {base}", file=self.path, remedy=f"frames are {known}"
            )
        return chain

    def _transforms(self) -> tuple[list[Sample], list[Sample]]:
        """Samples of what never moves and of what does."""
        fixed: list[Sample] = []
        moving: list[Sample] = []
        own = [c for c in self.reader.connections if c.msgtype in _TF]
        if not own:
            return fixed, moving
        for connection, _, raw in self.reader.messages(connections=own):
            message: Any = self.reader.deserialize(raw, connection.msgtype)
            still = connection.topic.rstrip("/").endswith("tf_static")
            for one in message.transforms:
                t, q = one.transform.translation, one.transform.rotation
                sample = (
                    _nanoseconds(one.header.stamp),
                    str(one.header.frame_id).lstrip("/"),
                    str(one.child_frame_id).lstrip("/"),
                    (t.x, t.y, t.z),
                    (q.x, q.y, q.z, q.w),
                )
                (fixed if still else moving).append(sample)
        return fixed, moving


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    """Turn what rosbags raises on damaged files into one clear line."""
    try:
        yield
    except ScanError:
        raise
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror or error}", file=path) from error
    except Exception as error:
        # rosbags hands on whatever its parts make of damage: struct, zstd, lz4, sqlite, yaml, key, assertion.
        reason = str(error).strip() or type(error).__name__
        raise ScanError(f"not a ROS bag, or damaged: {reason[:200]}", file=path) from error


def _topic(path: Path, connections: list[Connection], wanted: str) -> str:
    """The topic to read."""
    found = {c.topic: c.msgtype for c in connections if c.msgtype in (_SCAN, _CLOUD)}
    named = ", ".join(f"{topic} ({kind.rsplit('/', 1)[1]})" for topic, kind in sorted(found.items()))
    if wanted:
        for topic in (wanted, f"/{wanted}"):
            if topic in found:
                return topic
        raise ScanError(f"no scan on topic {wanted}", file=path, remedy=f"there are {named or 'none'}")
    if not found:
        others = ", ".join(sorted({c.msgtype for c in connections})[:6])
        raise ScanError(
            f"the bag holds no LaserScan and no PointCloud2{f', only {others}' if others else ''}", file=path
        )
    if len(found) > 1:
        raise ScanError("the bag holds several scans", file=path, remedy=f"choose one by --topic: {named}")
    return next(iter(found))


def _time(message: Any, recorded: int) -> int:
    """When a message was measured, ns; its time of recording where it does not say."""
    return _nanoseconds(message.header.stamp) or recorded


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _placed(frame: str, chain: list[Edge]) -> str:
    if not chain:
        return f"frame {frame or '(none)'}, in its own coordinates: the bag places it nowhere"
    way = " > ".join(edge.parent for edge in reversed(chain))
    return f"in the coordinates of {chain[-1].parent}, by tf {way} > {frame}"


def _joined(beams: list[LineScan]) -> LineScan:
    names = set.intersection(*(set(piece.extra) for piece in beams))
    return LineScan(
        np.concatenate([piece.scan for piece in beams]),
        np.concatenate([piece.origins for piece in beams]),
        np.concatenate([piece.directions for piece in beams]),
        np.concatenate([piece.ranges for piece in beams]),
        beams[0].source,
        extra={name: np.concatenate([piece.extra[name] for piece in beams]) for name in sorted(names)},
    )
