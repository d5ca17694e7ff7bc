"""Clouds larger than memory, in figures: one pass over a file against laspy's own reading of it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.pipeline.bench_sensor import Figures, Progress
from bimfit.pipeline.samples import sample_model

POINTS, PACKED_POINTS = 20_000_000, 2_000_000
_STEP, _CHUNK, _REPEATS = 1e-4, 1_000_000, 3
_NEAR = 0.03
_SITE = 40.0
_EYE = np.array([6.0, -8.0, 1.6])

_READ = """
import time, laspy, numpy as np
times = []
for _ in range({repeats}):
    begun = time.perf_counter()
    with laspy.open({path!r}) as reader:
        for chunk in reader.chunk_iterator({chunk}):
            if {coordinates}:
                [np.asarray(axis) for axis in (chunk.x, chunk.y, chunk.z)]
    times.append(time.perf_counter() - begun)
"""
_CUT = """
import time
from pathlib import Path
from bimfit.config import Config
from bimfit.pipeline.placing import Placing, place_scan
from bimfit.pipeline.survey import covered_joints, cut_joint, model_joints, part_of
config = Config()
model, joints = model_joints(Path({model!r}), config.joints)
place_scan(Path({warm!r}), model, joints, config, Placing())
times = []
for _ in range({repeats}):
    placed = None
    begun = time.perf_counter()
    placed = place_scan(Path({path!r}), model, joints, config, Placing())
    times.append(time.perf_counter() - begun)
begun = time.perf_counter()
shown = covered_joints(joints, placed.nearby, config, asked=False)
cuts = [cut_joint(model, joint, part_of(placed.nearby, joint, config), config) for joint in shown]
more = {{
    "near": len(placed.nearby.scan), "level": placed.nearby.level, "joints": len(shown),
    "stations": sum(len(cut[2]) for cut in cuts), "cutting": time.perf_counter() - begun,
}}
"""
_TELL = """
import json, resource
most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"seconds": min(times), "mebibytes": most, **globals().get("more", {})}))
"""


def size(seed: int, progress: Progress) -> Figures:
    """A generated site of 20 million points as LAS, and of 2 million as LAZ: time against laspy's, memory."""
    with tempfile.TemporaryDirectory(prefix="bimfit-bench-") as folder:
        rows = []
        for k, (name, count) in enumerate((("site.las", POINTS), ("site.laz", PACKED_POINTS))):
            progress(f"{count // 1_000_000} million points", 0.5 * k)
            path = Path(folder) / name
            write_site(path, count, seed)
            rows.append(measure(path))
            path.unlink()
    return Figures("\n".join(row_text(row) for row in rows), {"rows": rows})


def measure(path: Path, repeats: int = _REPEATS) -> dict[str, Any]:
    """Times (least of several) and memory of reading a LAS file in chunks, and of cutting all joints from it.

    Each in a process of its own.

    Returns
    -------
    dict
        ``laspy``, ``laspy_xyz`` (coordinates made as well) and ``bimfit``, each with ``seconds`` and
        ``mebibytes``; ``ratio`` of bimfit to laspy, ``ratio_xyz``; ``points`` and ``bytes`` of the file.
    """
    import laspy

    with tempfile.TemporaryDirectory(prefix="bimfit-bench-") as folder:
        warm = Path(folder) / "warm.las"
        write_site(warm, 10_000, 0)
        read = {"path": str(path), "chunk": _CHUNK, "repeats": repeats}
        model = str(sample_model("facade.ifc"))
        row: dict[str, Any] = {
            "laspy": _run(_READ.format(**read, coordinates=False)),
            "laspy_xyz": _run(_READ.format(**read, coordinates=True)),
            "bimfit": _run(_CUT.format(**read, model=model, warm=str(warm))),
        }
    with laspy.open(path) as reader:
        row |= {"file": path.name, "points": int(reader.header.point_count), "bytes": path.stat().st_size}
    row["ratio"] = row["bimfit"]["seconds"] / row["laspy"]["seconds"]
    row["ratio_xyz"] = row["bimfit"]["seconds"] / row["laspy_xyz"]["seconds"]
    return row


def row_text(row: dict[str, Any]) -> str:
    """The figures in words."""
    own, raw, xyz = row["bimfit"], row["laspy"], row["laspy_xyz"]
    return (
        f"size: {row['points'] / 1e6:g} million points, {row['file']} of {row['bytes'] / 2**30:.2f} GiB: "
        f"{own['near']:,} near {own['joints']} joints in one pass of {own['seconds']:.2f} s and "
        f"{own['mebibytes']:.0f} MiB ({own['stations']} stations cut in another {own['cutting']:.2f} s); "
        f"laspy reads the chunks alone in {raw['seconds']:.2f} s (ratio {row['ratio']:.2f}), with their "
        f"coordinates in {xyz['seconds']:.2f} s (ratio {row['ratio_xyz']:.2f})"
    )


def write_site(path: Path, count: int, seed: int) -> None:
    """Write a scan of a site 80 m wide, a million points at a time: ground, walls, and 3 % on the facade.

    Points come as from a scanner that turns about itself, in map-like order: one bearing after the other.
    """
    import laspy

    from bimfit.bim.model import load_model

    mesh = [element.mesh for element in load_model(sample_model("facade.ifc")).elements]
    triangles = np.concatenate([m.triangles for m in mesh])
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, _STEP), np.zeros(3)
    rng = np.random.default_rng(seed)
    with laspy.open(path, "w", header=header) as writer:
        for start in range(0, count, _CHUNK):
            number = min(_CHUNK, count - start)
            near = round(_NEAR * number)
            points = np.concatenate([_on_faces(triangles, near, rng), _on_site(number - near, rng)])
            points = points[np.argsort(np.arctan2(points[:, 1] - _EYE[1], points[:, 0] - _EYE[0]))]
            record = laspy.ScaleAwarePointRecord.zeros(number, header=header)
            record.x, record.y, record.z = points.T
            writer.write_points(record)


def _on_faces(triangles: Array, count: int, rng: np.random.Generator) -> Array:
    """Evenly over triangles (m, 3, 3), with the noise of 2 mm."""
    edge, other = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = np.linalg.norm(np.cross(edge, other), axis=1)
    k = rng.choice(len(area), count, p=area / area.sum())
    a, b = rng.random((2, count))
    over = a + b > 1.0
    a[over], b[over] = 1.0 - a[over], 1.0 - b[over]
    on = triangles[k, 0] + a[:, None] * edge[k] + b[:, None] * other[k]
    return np.asarray(on + rng.normal(0.0, 0.002, on.shape))


def _on_site(count: int, rng: np.random.Generator) -> Array:
    """Ground and walls around, none of them at the facade."""
    points = rng.uniform(-_SITE, _SITE, (count, 3))
    ground = rng.random(count) < 0.6
    points[ground, 2] = rng.normal(-1.2, 0.02, int(ground.sum()))
    wall = ~ground
    points[wall, 1] = np.where(rng.random(int(wall.sum())) < 0.5, -_SITE, _SITE)
    points[wall, 2] = rng.uniform(-1.2, 12.0, int(wall.sum()))
    return np.asarray(points)


def _run(code: str) -> dict[str, Any]:
    done = subprocess.run([sys.executable, "-c", code + _TELL], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(
            done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "the child failed"
        )
    values: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return values
