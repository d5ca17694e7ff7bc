"""ROS bags of all three kinds, written by rosbags' own writers: a robot that drives and turns past a wall."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import bag, read_scan, scan_chunks
from bimfit.scan.formats.options import ReadOptions

pytest.importorskip("rosbags")
KINDS = ("ros1", "ros2", "mcap")
MAP = np.array([458657.0, 5438232.0, 12.0])
START = 1_700_000_000_000_000_000
MOUNT = (0.2, -0.1, 0.5), Rotation.from_euler("zyx", (0.3, 0.2, -0.1))
"""The laser on the robot."""
PLANE, AWAY = np.array([0.8, 0.6, 0.0]), 6.0
"""The wall: PLANE . (x - MAP) = AWAY."""


def robot(seconds):
    """Where the robot is (n, 3) and how it is turned: evenly, so that interpolation is exact."""
    s = np.atleast_1d(seconds)
    at = MAP + np.outer(s, (0.4, -0.3, 0.0))
    return at, Rotation.from_rotvec(np.outer(0.1 * s + 0.3, (0.0, 0.0, 1.0)))


def laser(seconds):
    at, turn = robot(seconds)
    return at + turn.apply(MOUNT[0]), turn * MOUNT[1]


class Bag:
    """A bag being written."""

    def __init__(self, folder, kind):
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if kind == "ros1":
            text = "geometry_msgs/TransformStamped[] transforms"  # which rosbags does not know by itself
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
            self.path = folder / "a.bag"
            self.writer = Writer1(self.path)
        else:
            self.path = folder / kind
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.topics = {}
        self.count = 0

    def make(self, kind, **fields):
        return self.store.types[kind](**fields)

    def stamp(self, ns):
        return self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)

    def header(self, ns, frame):
        self.count += 1
        more = {"seq": self.count} if self.kind == "ros1" else {}
        return self.make("std_msgs/msg/Header", stamp=self.stamp(ns), frame_id=frame, **more)

    def write(self, topic, message, ns):
        kind = message.__msgtype__
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        self.writer.write(self.topics[topic], ns, pack(message, kind))

    def transform(self, ns, parent, child, at, turn, topic="/tf"):
        x, y, z, w = turn.as_quat().tolist()
        x0, y0, z0 = (float(value) for value in at)
        one = self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(ns, parent), child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", x=x0, y=y0, z=z0),
                rotation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            ),
        )  # fmt: skip
        self.write(topic, self.make("tf2_msgs/msg/TFMessage", transforms=[one]), ns)

    def drive(self, seconds, *, pace=0.1):
        """tf of the robot, every ``pace`` seconds, and of its laser, once."""
        self.transform(START, "base", "laser", MOUNT[0], MOUNT[1], "/tf_static")
        self.transform(START, "map", "odom", MAP, Rotation.identity(), "/tf_static")
        for s in np.arange(0.0, seconds + 1e-9, pace):
            at, turn = robot(s)
            self.transform(START + round(s * 1e9), "odom", "base", (at - MAP)[0], turn[0])

    def scan(self, ns, ranges, *, first=-0.7, step=0.01, pace=2e-4, frame="laser", topic="/scan", **more):
        fields = {
            "header": self.header(ns, frame),
            "angle_min": first,
            "angle_max": first + (len(ranges) - 1) * step,
            "angle_increment": step,
            "time_increment": pace,
            "scan_time": 0.1,
            "range_min": 0.1,
            "range_max": 30.0,
            "ranges": np.asarray(ranges, np.float32),
            "intensities": np.zeros(0, np.float32),
        }
        self.write(topic, self.make("sensor_msgs/msg/LaserScan", **(fields | more)), ns)

    def cloud(self, ns, columns, *, frame="laser", topic="/points", height=1, **more):
        codes = {"f4": 7, "f8": 8, "u4": 6, "u2": 4, "u1": 2}
        table = np.zeros(len(columns["x"]), [(name, values.dtype.str) for name, values in columns.items()])
        fields = []
        for name, values in columns.items():
            table[name] = values
            code = codes[values.dtype.str[1:]]
            fields.append(
                self.make(
                    "sensor_msgs/msg/PointField",
                    name=name,
                    offset=table.dtype.fields[name][1],
                    datatype=code,
                    count=1,
                )
            )
        width = len(table) // height
        parts = {
            "header": self.header(ns, frame),
            "height": height,
            "width": width,
            "fields": fields,
            "is_bigendian": False,
            "point_step": table.itemsize,
            "row_step": table.itemsize * width,
            "is_dense": False,
            "data": np.frombuffer(table.tobytes(), np.uint8),
        }
        self.write(topic, self.make("sensor_msgs/msg/PointCloud2", **(parts | more)), ns)

    def close(self):
        self.writer.close()
        return next(self.path.glob("*.mcap")) if self.kind == "mcap" else self.path


def seen(seconds, directions):
    """Ranges to the wall from where the laser is at each time."""
    at, turn = laser(seconds)
    way = turn.apply(directions)
    return (AWAY - (at - MAP) @ PLANE) / (way @ PLANE), at, way


COUNT = 141
ANGLES = -0.7 + 0.01 * np.arange(COUNT)
FAN = np.stack([np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES], axis=1)


def driven(folder, kind, *, stamps=(0.05, 0.42, 1.3), length=2.0):
    out = Bag(folder, kind)
    out.drive(length)
    for s in stamps:
        out.scan(START + round(s * 1e9), seen(s + 2e-4 * np.arange(COUNT), FAN)[0])
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_every_beam_of_a_moving_laser_starts_and_ends_where_it_did(tmp_path, kind):
    path = driven(tmp_path, kind).close()
    scan = read_scan(path)
    assert isinstance(scan, LineScan)
    assert np.array_equal(scan.scan, np.repeat([0, 1, 2], COUNT))
    for k, s in enumerate((0.05, 0.42, 1.3)):
        ranges, at, way = seen(s + 2e-4 * np.arange(COUNT), FAN)
        own = scan.scan == k
        assert np.allclose(scan.origins[own], at, rtol=0, atol=1e-6)
        assert np.allclose(scan.directions[own], way, atol=1e-6)
        assert np.allclose(scan.ranges[own], ranges, rtol=2e-7)
    # the wall is flat to 0.1 mm at map coordinates, though the robot drove 14 mm in a sweep
    assert np.abs((scan.hits - MAP) @ PLANE - AWAY).max() < 1e-4
    assert np.allclose(scan.extra["time"][:COUNT], START * 1e-9 + 0.05 + 2e-4 * np.arange(COUNT))
    assert any("in the coordinates of map, by tf map > odom > base > laser" in note for note in scan.notes)
    assert scan.notes[-1].startswith("ROS bag: 423 beams in 3 sweeps")
    without = read_scan(path, options=ReadOptions(frame="odom"))
    assert np.allclose(without.origins + MAP, scan.origins, rtol=0, atol=1e-8)


def test_ranges_that_are_none_are_missing_returns(tmp_path):
    made = Bag(tmp_path, "ros2")
    ranges = [1.0, np.inf, -np.inf, np.nan, 0.05, 31.0, 0.0, 30.0, 0.1]
    made.scan(START, ranges, intensities=np.arange(9, dtype=np.float32))
    scan = read_scan(made.close())
    assert np.array_equal(scan.returned, [True, *[False] * 6, True, True])
    assert np.array_equal(scan.extra["intensity"], np.arange(9))
    assert np.array_equal(scan.origins, np.zeros((9, 3)))
    assert any("in its own coordinates" in note for note in scan.notes)


def test_messages_beyond_the_transforms_are_left_out_and_said(tmp_path):
    path = driven(tmp_path, "ros2", stamps=(0.5, 1.95, 5.0)).close()
    scan = read_scan(path)
    assert len(scan.sweeps) == 2  # the second ends within a usual interval of the last transform
    assert any("1 messages at times without transforms" in note for note in scan.notes)
    nothing = driven(tmp_path / "n", "ros2", stamps=(7.0,)) if (tmp_path / "n").mkdir() is None else None
    with pytest.raises(ScanError, match="1 messages are all at times without transforms"):
        read_scan(nothing.close())


def test_several_topics_want_a_choice(tmp_path):
    made = driven(tmp_path, "ros1")
    made.scan(START + 10**8, np.full(5, 2.0), topic="/rear", frame="laser")
    made.cloud(START, {name: np.ones(3, "<f4") for name in "xyz"})
    path = made.close()
    with pytest.raises(
        ScanError, match=r"--topic: /points \(PointCloud2\), /rear \(LaserScan\), /scan \(LaserScan\)"
    ):
        read_scan(path)
    assert len(read_scan(path, options=ReadOptions(topic="/rear"))) == 5
    assert len(read_scan(path, options=ReadOptions(topic="scan"))) == 3 * COUNT
    assert isinstance(read_scan(path, options=ReadOptions(topic="/points")), PointCloud)
    with pytest.raises(ScanError, match="no scan on topic /front; there are /points"):
        read_scan(path, options=ReadOptions(topic="/front"))
    with pytest.raises(ScanError, match="frame laser is not under world; frames are base, laser, map, odom"):
        read_scan(path, options=ReadOptions(topic="/scan", frame="world"))


def wall_points(seconds, count=400, seed=0):
    rng = np.random.default_rng(seed)
    directions = np.stack(
        [np.ones(count), rng.uniform(-0.5, 0.5, count), rng.uniform(-0.3, 0.3, count)], axis=1
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges, at, way = seen(seconds, directions)
    return directions * ranges[:, None], at + way * ranges[:, None]


@pytest.mark.parametrize("kind", KINDS)
def test_points_are_carried_from_where_the_sensor_was(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(bag, "PIECE", 500)
    made = Bag(tmp_path, kind)
    made.drive(2.0)
    worlds = []
    for k, s in enumerate((0.3, 0.9, 1.4)):
        local, world = wall_points(np.full(400, s), seed=k)
        local[5], local[6] = np.nan, 0.0
        worlds.append(np.delete(world, [5, 6], axis=0))
        columns = dict(zip("xyz", local.T.astype("<f4"), strict=True)) | {
            "intensity": np.arange(400, dtype="<f4")
        }
        made.cloud(START + round(s * 1e9), columns)
    path = made.close()
    cloud = read_scan(path)
    # single precision of 8 m
    assert np.allclose(cloud.points, np.concatenate(worlds), rtol=0, atol=2e-6)
    assert np.array_equal(cloud.intensity[:8], [0, 1, 2, 3, 4, 7, 8, 9])
    pieces = list(scan_chunks(path))
    assert [len(p) for p in pieces] == [398] * 3
    for piece, s in zip(pieces, (0.3, 0.9, 1.4), strict=True):
        assert np.allclose(piece.viewpoint, laser(s)[0][0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("t", lambda s: np.round(s * 1e9).astype("<u4")),
        ("time", lambda s: s.astype("<f4")),
        ("timestamp", lambda s: START * 1e-9 + 0.5 + s),
        ("timestamp", lambda s: START + 0.5e9 + s * 1e9),
    ],
)
def test_points_that_know_their_times_are_carried_each_by_its_own(tmp_path, name, values):
    after = np.linspace(0.0, 0.1, 400)
    local, world = wall_points(0.5 + after)
    made = Bag(tmp_path, "ros2")
    made.drive(2.0)
    made.cloud(START + 5 * 10**8, dict(zip("xyz", local.T, strict=True)) | {name: values(after)})
    cloud = read_scan(made.close())
    assert np.allclose(cloud.points, world, rtol=0, atol=1e-6)
    assert np.abs((cloud.points - MAP) @ PLANE - AWAY).max() < 1e-6


def test_organised_and_padded_clouds(tmp_path):
    made = Bag(tmp_path, "mcap")
    x = np.arange(1.0, 7.0)
    table = np.zeros((2, 4), [("x", "<f4"), ("pad", "<u4"), ("y", "<f4"), ("z", "<f4"), ("rest", "<u2", 3)])
    for k, axis in enumerate("xyz"):
        table[axis][:, :3] = (x + 10 * k).reshape(2, 3)
    fields = [
        made.make("sensor_msgs/msg/PointField", name=n, offset=table.dtype.fields[n][1], datatype=7, count=1)
        for n in "xyz"
    ]
    more = {
        "width": 3,
        "height": 2,
        "point_step": table.itemsize,
        "row_step": 4 * table.itemsize,
        "fields": fields,
        "data": np.frombuffer(table.tobytes(), np.uint8),
    }
    made.cloud(START, {n: np.ones(6, "<f4") for n in "xyz"}, **more)
    cloud = read_scan(made.close())
    assert np.array_equal(cloud.points, np.stack([x, x + 10, x + 20], axis=1))


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ({"width": 10**9}, "cut short"),
        ({"height": 2**31, "width": 2**31}, "cut short"),
        ({"point_step": 0}, "cut short"),
        ({"fields": []}, "without x, y and z"),
    ],
)
def test_clouds_that_belie_their_size(tmp_path, more, complaint):
    made = Bag(tmp_path, "ros1")
    more = {k: min(v, 2**32 - 1) if isinstance(v, int) else v for k, v in more.items()}
    made.cloud(START, {name: np.ones(6, "<f4") for name in "xyz"}, **more)
    with pytest.raises(ScanError, match=complaint):
        read_scan(made.close())


def test_bags_without_scans_and_folders_that_are_none(tmp_path):
    made = Bag(tmp_path, "ros2")
    made.drive(0.2)
    with pytest.raises(ScanError, match="no LaserScan and no PointCloud2, only tf2_msgs"):
        read_scan(made.close())
    (tmp_path / "empty").mkdir()
    with pytest.raises(ScanError, match="is a folder; name a scan file, or the folder of a ROS 2 bag"):
        read_scan(tmp_path / "empty")


def test_bags_without_rosbags_name_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    (tmp_path / "c.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(400))
    with pytest.raises(ScanError, match=r"bimfit\[ros\]"):
        read_scan(tmp_path / "c.bag")


@pytest.mark.parametrize("kind", ["ros1", "mcap", "ros2"])
def test_damaged_bags_are_read_or_refused_but_never_crash(tmp_path, kind):
    made = driven(tmp_path, kind, length=1.4)
    path = made.close()
    file = next(path.glob("*.db3")) if kind == "ros2" else path
    data = np.frombuffer(file.read_bytes(), np.uint8)
    rng = np.random.default_rng(7)
    refused = 0
    for k in range(24):
        bad = data.copy()
        if k < 6:
            bad = bad[: int((0.001, 0.02, 0.3, 0.6, 0.9, 0.99)[k] * len(bad))]
        else:
            low = len(bad) * 3 // 4 if k % 3 == 0 else 0
            places = rng.integers(low, len(bad) if k % 2 else min(len(bad), low + 2000), rng.integers(1, 6))
            bad[places] = rng.integers(0, 256, len(places))
        file.write_bytes(bad.tobytes())
        try:
            scan = read_scan(path)
        except ScanError as error:
            assert "\n" not in str(error) and str(path) in str(error)
            refused += 1
        else:
            assert np.isfinite(scan.directions).all() and np.isfinite(scan.origins).all()
    assert refused >= 6


def test_frames_that_hang_on_one_another_end():
    from bimfit.scan.formats.frames import Frames, chained

    still = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    frames = Frames([], [(0, "a", "b", *still), (0, "b", "a", *still), (0, "a", "c", *still)])
    assert [edge.parent for edge in frames.chain("c")] == ["a", "b"]
    assert frames.chain("c", "z") is None
    T, known = chained(frames.chain("c"), np.array([5, 6]))
    assert known.all() and np.array_equal(T, np.tile(np.eye(4), (2, 1, 1)))
    broken = Frames([(0, "a", "b", (np.nan, 0.0, 0.0), still[1]), (0, "a", "c", still[0], (0.0,) * 4)], [])
    assert broken.names == []
