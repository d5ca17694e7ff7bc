"""Values on the command line: lengths and angles with units, and settings put together."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np

from bimfit.config import Config, JointConfig, ShapeConfig, Triple, load_config
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array

_LENGTHS = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
_ANGLES = {"": 1.0, "rad": 1.0, "deg": math.pi / 180.0, "°": math.pi / 180.0}
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Z°]*)\s*")
_LONGEST = 10.0


def length(text: str, option: str) -> float:
    """A length such as ``0.01``, ``10mm`` or ``1cm`` in metres.

    Raises
    ------
    ConfigError
        Naming the option, when it is no length.
    """
    value = _quantity(text, option, _LENGTHS, "0.01, 10mm")
    if abs(value) > _LONGEST:
        raise ConfigError(f"{option} {text}: that is {value:g} m", remedy="write the unit, as in 10mm")
    return value


def angle(text: str, option: str) -> float:
    """An angle such as ``30deg`` or ``0.5`` in radians.

    Raises
    ------
    ConfigError
        Naming the option, when it is no angle.
    """
    return _quantity(text, option, _ANGLES, "30deg")


def speed(text: str, option: str = "--speed") -> float:
    """A speed such as ``0.05``, ``50mm`` or ``50mm/s`` in metres a second.

    Raises
    ------
    ConfigError
        Naming the option, when it is no speed.
    """
    return length(text.removesuffix("/s"), option)


def pose_triple(text: str, option: str) -> Triple:
    """Three numbers ``u,v,theta`` as metres and radians, each with an optional unit (mm, cm, m; rad, deg).

    Raises
    ------
    ConfigError
        Naming the option and the example to follow.
    """
    parts = text.split(",")
    if len(parts) != 3:
        raise ConfigError(
            f"{option} {text}: wants three values", remedy=f"such as {option} 121.5mm,121.5mm,45deg"
        )
    theta = _quantity(parts[2], option, _ANGLES, "45deg")
    return length(parts[0], option), length(parts[1], option), theta


def _quantity(text: str, option: str, units: dict[str, float], example: str) -> float:
    found = _QUANTITY.fullmatch(text)
    if not found or found.group(2) not in units:
        raise ConfigError(
            f"{option} {text}: not a number with a unit of {', '.join(k for k in units if k)}",
            remedy=f"write it as {example}",
        )
    return float(found.group(1)) * units[found.group(2)]


MISSING_HELP = "What a beam says that returned nothing: gap (default), or unknown, as on shiny surfaces."


def build_config(
    file: Path | None,
    *,
    window: str | None = None,
    tolerance: str | None = None,
    spacing: str | None = None,
    thickness: str | None = None,
    sigma: str | None = None,
    missing: str | None = None,
    shape: str | None = None,
) -> Config:
    """Settings from a TOML file, with what the command line says on top.

    Raises
    ------
    ConfigError
        For a value that cannot be used, naming where it came from.
    """
    config = load_config(file) if file else Config()
    search, slices, sensor = config.search, config.slices, config.sensor
    if window:
        search = dataclasses.replace(search, window=pose_triple(window, "--window"))
    if tolerance:
        search = dataclasses.replace(search, tolerance=pose_triple(tolerance, "--tolerance"))
    if spacing:
        slices = dataclasses.replace(slices, spacing=length(spacing, "--spacing"))
    if thickness:
        slices = dataclasses.replace(slices, thickness=length(thickness, "--thickness"))
    if sigma:
        sensor = dataclasses.replace(sensor, sigma=length(sigma, "--sigma"), adapt=False)
    if missing:
        sensor = dataclasses.replace(sensor, missing=missing)  # type: ignore[arg-type]  # checked there
    freedoms = shape_config(shape, config.shape) if shape else config.shape
    return dataclasses.replace(config, search=search, slices=slices, sensor=sensor, shape=freedoms)


def shape_config(text: str, base: ShapeConfig | None = None) -> ShapeConfig:
    """Shape freedoms from ``bevel-angle=2deg,face-angle=1deg,thickness=1mm``: prior standard deviations.

    Raises
    ------
    ConfigError
        For a freedom that does not exist or a value that is none.
    """
    known = {"bevel-angle": angle, "face-angle": angle, "thickness": length}
    values: dict[str, float] = {}
    for word in text.split(","):
        name, _, value = word.strip().partition("=")
        if name not in known or not value:
            raise ConfigError(
                f"--shape {text}: {word.strip() or 'nothing'} is no freedom with a value",
                remedy="such as --shape bevel-angle=2deg,face-angle=1deg,thickness=1mm",
            )
        values[name.replace("-", "_")] = known[name](value, f"--shape {name}")
    return dataclasses.replace(base or ShapeConfig(), **values)


def joint_config(max_gap: str | None, base: JointConfig | None = None) -> JointConfig:
    """How far apart the finder looks, from ``--max-gap``.

    Raises
    ------
    ConfigError
        For a length that cannot be used.
    """
    config = base or JointConfig()
    if max_gap:
        config = dataclasses.replace(config, max_gap=length(max_gap, "--max-gap"))
    return config


def read_pose(text: str) -> Array:
    """A scanner pose T_world_scanner: six numbers (m and a rotation vector, rad) or a file of 16, row-major.

    Raises
    ------
    ConfigError
        When it is neither, or the matrix is not a rigid motion.
    """
    from scipy.spatial.transform import Rotation

    source = Path(text)
    words = source.read_text(encoding="utf-8") if source.is_file() else text
    try:
        numbers = np.array([float(word) for word in re.split(r"[,;\s]+", words.strip()) if word])
    except (ValueError, UnicodeDecodeError):
        numbers = np.zeros(0)
    if not np.all(np.isfinite(numbers)) or len(numbers) not in (6, 16):
        raise ConfigError(
            f"--scan-pose {text}: not a pose", remedy="give x,y,z,rx,ry,rz or a file of 16 numbers"
        )
    T = np.eye(4)
    if len(numbers) == 16:
        T = numbers.reshape(4, 4)
        rigid = np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6) and np.linalg.det(T[:3, :3]) > 0
        if not rigid or not np.allclose(T[3], (0, 0, 0, 1)):
            raise ConfigError(
                f"--scan-pose {text}: not a rigid motion", remedy="its rows are R | t and 0 0 0 1"
            )
    else:
        T[:3, :3] = Rotation.from_rotvec(numbers[3:]).as_matrix()
        T[:3, 3] = numbers[:3]
    return T
