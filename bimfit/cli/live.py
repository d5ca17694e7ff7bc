"""``bimfit live``: fit each sweep as it comes."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bimfit.cli.interrupts import stoppable
from bimfit.cli.options import MISSING_HELP, angle, build_config, length, read_pose
from bimfit.cli.options import speed as read_speed
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.pipeline.live import Live
    from bimfit.pipeline.live_fit import LiveStation

_HEAD = f"{'sweep':>5} {'s mm':>8} {'width mm':>8} {'+/-':>5} {'u mm':>7} {'v mm':>7} {'deg':>6}  status"


def run(
    model: Path = typer.Argument(..., metavar="MODEL.ifc", help="The building model."),
    joint: str | None = typer.Option(
        None, "--joint", metavar="ID|GUID,GUID", help="The joint; default: the longest open one."
    ),
    port: str | None = typer.Option(
        None, "--port", metavar="PORT", help="Such as /dev/ttyACM0; default: the one Hokuyo by USB."
    ),
    speed: str | None = typer.Option(None, "--speed", help="Of the sensor along the joint, m/s."),
    replay: Path | None = typer.Option(
        None, "--replay", metavar="FILE", help="A recorded line scan or SCIP dialogue instead of a sensor."
    ),
    start: str = typer.Option("0", "--start", help="Where along the joint the first sweep is, such as 10mm."),
    height: str = typer.Option("0.25", "--height", help="Of the sensor over the designed mouth."),
    pose: str | None = typer.Option(
        None, "--scan-pose", metavar="POSE|FILE", help="Sensor's pose in the model at the first sweep."
    ),
    trajectory: Path | None = typer.Option(
        None,
        "--trajectory",
        metavar="FILE",
        help="Instead of a speed: poses in TUM format, by the host's clock or from the first sweep on; "
        "--scan-pose is then the sensor's on the moving body.",
    ),
    flip: bool = typer.Option(False, "--flip", help="The sensor looks into the joint's other mouth."),
    mirrored: bool = typer.Option(
        False, "--mirrored", help="The sensor is mounted the other way up: bearings grow from B towards A."
    ),
    field: str = typer.Option("30deg", "--field", help="Half opening about straight ahead that is measured."),
    sweeps: int | None = typer.Option(None, "--sweeps", metavar="N", min=1, help="End after so many sweeps."),
    sigma: str | None = typer.Option(None, "--sigma", help="The sensor's range noise, such as 3mm."),
    missing: str | None = typer.Option(None, "--missing", metavar="gap|unknown", help=MISSING_HELP),
    config: Path | None = typer.Option(None, "--config", metavar="FILE.toml", help="Settings."),
    as_json: bool = typer.Option(False, "--json", help="Print a JSON object a sweep."),
) -> int:
    """Fit each sweep of a sensor as it comes, a line a sweep, until the joint's end or until interrupted.

    A line has the place along the joint, the mouth's width with its sigma, the offset of its middle across
    (u) and out of the mouth (v), its angle, and the status.
    """
    from bimfit.pipeline.carriage import Mount
    from bimfit.pipeline.live import Live
    from bimfit.scan.trajectory import read_tum

    mount = Mount(
        None if speed is None else read_speed(speed),
        length(start, "--start"),
        length(height, "--height"),
        None if pose is None else read_pose(pose),
        None if trajectory is None else read_tum(trajectory),
        flip,
        mirrored,
    )
    settings = build_config(config, sigma=sigma, missing=missing)
    half = angle(field, "--field")
    if replay is not None and port is not None:
        raise ConfigError("--replay and --port exclude one another", remedy="give one of them")
    found: list[LiveStation] = []
    stopped = False
    with stoppable():
        try:
            live = Live(model, joint, mount, settings)
            stream = (
                live.replay(replay)
                if replay is not None
                else live.stream(port, field=half, sweeps=sweeps, told=_note)
            )
            with closing(stream):  # type: ignore[type-var]
                _follow(stream, as_json, sweeps, found)
        except KeyboardInterrupt:
            stopped = True
    return _conclude(live, found, stopped) if found else 0


def _follow(
    stream: Iterator[LiveStation], as_json: bool, sweeps: int | None, found: list[LiveStation]
) -> None:
    for station in stream:
        if not found and not as_json:
            print(_HEAD)
        print(json.dumps(_plain(station)) if as_json else _line(station), flush=True)
        found.append(station)
        if len(found) == sweeps:
            return


def _note(text: str) -> None:
    print(f"bimfit: note: {text}", file=sys.stderr, flush=True)


def _line(station: LiveStation) -> str:
    where = f"{station.index:5d} {_mm(station.s, 8)}"
    verdict = ": ".join(part for part in (station.status.name, station.status.reason) if part)
    gap = station.gap
    if gap is None:
        return f"{where} {'-':>8} {'-':>5} {'-':>7} {'-':>7} {'-':>6}  {verdict}"
    sigma = math.nan if gap.sigma is None else gap.sigma.width
    u, v = gap.origin
    return (
        f"{where} {_mm(gap.width_mouth, 8)} {_mm(sigma, 5)} {_mm(u, 7)} {_mm(v, 7)}"
        f" {math.degrees(gap.angle):6.2f}  {verdict}"
    )


def _mm(value: float, width: int) -> str:
    return f"{value * 1e3:{width}.2f}" if math.isfinite(value) else f"{'-':>{width}}"


def _plain(station: LiveStation) -> dict[str, Any]:
    gap = station.gap
    sigma = None if gap is None else gap.sigma
    known = {
        "width": None if gap is None else gap.width_mouth,
        "u": None if gap is None else float(gap.origin[0]),
        "v": None if gap is None else float(gap.origin[1]),
        "angle": None if gap is None else gap.angle,
        "sigma": None
        if sigma is None
        else {"width": sigma.width, "u": sigma.x, "v": sigma.y, "angle": sigma.angle},
    }
    return {
        "sweep": station.index,
        "s": None if math.isnan(station.s) else station.s,
        **known,
        "status": station.status.name,
        "reason": station.status.reason,
        "stamp": None if math.isnan(station.stamp) else station.stamp,
        "latency": None if math.isnan(station.latency) else station.latency,
    }


def _conclude(live: Live, found: list[LiveStation], stopped: bool) -> int:
    late = sorted(s.latency for s in found if not math.isnan(s.latency))
    measured = sum(s.gap is not None for s in found)
    text = f"{measured} of {len(found)} sweeps measured"
    if late:
        half = late[len(late) // 2]
        text += f"; last byte to line {half * 1e3:.0f} ms, at most {late[-1] * 1e3:.0f} ms"
    lost = {"turns missing": live.counters.missing, "times unplugged": live.counters.unplugged}
    _note("; ".join([text, *(f"{count} {what}" for what, count in lost.items() if count)]))
    if measured or stopped:
        return 0
    reason = found[-1].status.reason
    print(f"bimfit: joint {live.joint.id} could not be estimated: {reason}", file=sys.stderr)
    return 1
