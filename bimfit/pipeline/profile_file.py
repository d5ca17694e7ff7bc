"""Files of taught profiles: a joint's cross-section in place of the one that BIM gives.

JSON, metres, section coordinates: u across from A to B, v out of the mouth, the origin midway between the
designed mouth corners of the joint that it was taught at::

    {"kind": "bimfit-profile", "schema": 1, "units": {"length": "m"},
     "components": [{"loops": [[[u, v], ...]], "artificial": [[false, ...]]}, {...}],
     "gap": {"side_a": [[u, v], ...], "side_b": [[u, v], ...]},
     "taught": {"scan": "...", "joint": "...", "slices": 12, ...}}

``components`` are A and B. Material lies to the left of every edge; ``artificial`` says of each edge whether
it is no surface but where the view ended, and may be left out. Each side of the ``gap`` runs along its
component from the mouth corner to the root.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bimfit import __version__
from bimfit.errors import ConfigError
from bimfit.files import write_text
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile, signed_area

KIND, SCHEMA = "bimfit-profile", 1


@dataclasses.dataclass(frozen=True)
class TaughtProfile:
    """The cross-section of both components and of the gap, and where it is from."""

    components: tuple[Profile, Profile]
    gap: GapOutline
    taught: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def from_source(self, **said: Any) -> TaughtProfile:
        """The same, saying where it is from as well."""
        return dataclasses.replace(self, taught={**said, **self.taught})

    def applied(self, sections: Sequence[JointSection]) -> tuple[JointSection, ...]:
        """These sections with the taught shape in place of the design."""
        return tuple(dataclasses.replace(s, components=self.components, gap=self.gap) for s in sections)


def write_profile(profile: TaughtProfile, path: Path) -> None:
    """Write a profile; floats keep every digit."""
    data = {
        "kind": KIND,
        "schema": SCHEMA,
        "bimfit": __version__,
        "units": {"length": "m"},
        "components": [
            {
                "loops": [loop.tolist() for loop in c.loops],
                "artificial": [flags.tolist() for flags in c.artificial],
            }
            for c in profile.components
        ],
        "gap": {"side_a": profile.gap.side_a.tolist(), "side_b": profile.gap.side_b.tolist()},
        "taught": dict(profile.taught),
    }
    write_text(path, json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_profile(path: Path) -> TaughtProfile:
    """Read a profile.

    Raises
    ------
    ConfigError
        Naming the file and the place in it, when it is no such file or its shapes are none.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=path) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(
            f"not JSON: {error}", file=path, remedy="bimfit teach writes such a file"
        ) from error
    if not isinstance(data, dict) or data.get("kind") != KIND:
        raise ConfigError("is no bimfit profile", file=path, remedy="bimfit teach writes such a file")
    if data.get("schema") != SCHEMA:
        raise ConfigError(
            f"has schema {data.get('schema')!r}, this version reads {SCHEMA}",
            file=path,
            remedy="teach it anew",
        )
    parts = data.get("components")
    gap = data.get("gap")
    if not isinstance(parts, list) or len(parts) != 2 or not isinstance(gap, dict):
        raise ConfigError("wants two components and a gap", file=path)
    a, b = (_component(part, f"components[{k}]", path) for k, part in enumerate(parts))
    sides = [_points(gap.get(name), f"gap.{name}", 2, path) for name in ("side_a", "side_b")]
    taught = data.get("taught")
    return TaughtProfile((a, b), GapOutline(*sides), taught if isinstance(taught, dict) else {})


def _component(part: Any, place: str, path: Path) -> Profile:
    if not isinstance(part, dict) or not isinstance(part.get("loops"), list) or not part["loops"]:
        raise ConfigError(f"{place} wants loops", file=path)
    loops = tuple(_points(loop, f"{place}.loops[{k}]", 3, path) for k, loop in enumerate(part["loops"]))
    if sum(signed_area(loop) for loop in loops) <= 0.0:
        raise ConfigError(f"{place}: its outer loop must run counter-clockwise", file=path)
    marks = part.get("artificial") or []
    good = isinstance(marks, list) and (not marks or len(marks) == len(loops))
    good = good and all(
        isinstance(row, list) and len(row) == len(loop) and all(isinstance(x, bool) for x in row)
        for row, loop in zip(marks, loops, strict=False)
    )
    if not good:
        raise ConfigError(f"{place}.artificial wants true or false for each edge of each loop", file=path)
    return Profile(loops, artificial=tuple(np.array(row, bool) for row in marks))


def _points(value: Any, place: str, least: int, path: Path) -> Array:
    try:
        points = np.array(value, float)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < least or not np.isfinite(points).all():
        raise ConfigError(f"{place} wants at least {least} points [u, v] in metres", file=path)
    if float(np.abs(points).max()) > 100.0:
        raise ConfigError(f"{place} reaches farther than 100 m", file=path, remedy="write metres")
    return points
