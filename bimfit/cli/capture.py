"""``bimfit capture``: record a real rangefinder."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import typer

from bimfit.cli.interrupts import stoppable, undisturbed
from bimfit.cli.options import angle, read_pose
from bimfit.cli.options import speed as read_speed
from bimfit.cli.progress import terminal_progress


def run(
    output: Path = typer.Option(
        ..., "-o", "--output", metavar="SCAN", help="Line scan to write (csv or npz)."
    ),
    port: str | None = typer.Option(
        None, "--port", metavar="PORT", help="Such as /dev/ttyACM0; default: the one Hokuyo by USB."
    ),
    sweeps: int | None = typer.Option(None, "--sweeps", metavar="N", help="End after so many sweeps."),
    seconds: float | None = typer.Option(None, "--seconds", metavar="S", help="End after so long."),
    field: str | None = typer.Option(
        None, "--field", help="Half opening about straight ahead, such as 30deg; default: all."
    ),
    speed: str | None = typer.Option(
        None, "--speed", help="Of the sensor along its z axis, out of its plane, m/s; default 0."
    ),
    pose: str | None = typer.Option(
        None,
        "--scan-pose",
        metavar="POSE|FILE",
        help="Sensor's pose in the model at the first sweep: x,y,z,rx,ry,rz (m, rad), or 16 numbers.",
    ),
) -> int:
    """Record a laser rangefinder (SCIP 2.0) until enough or until interrupted."""
    from bimfit.files import protect_inputs
    from bimfit.pipeline.capture import check_length, check_output, record

    check_length(sweeps, seconds)
    way = 0.0 if speed is None else read_speed(speed)
    half = None if field is None else angle(field, "--field")
    start = None if pose is None else read_pose(pose)
    protect_inputs([output], [Path(pose)] if pose is not None and len(pose) < 200 else [])
    check_output(output)
    with stoppable():
        with terminal_progress() as progress:
            last = sweeps or (math.ceil(seconds * 10.0) if seconds else 0)

            def told(count: int) -> None:
                progress(f"{count} sweeps", min(count / last, 1.0) if last else 0.0)

            made = record(
                port,
                output,
                sweeps=sweeps,
                seconds=seconds,
                field=half,
                speed=way,
                pose=start,
                told=told,
                note=lambda text: print(f"bimfit: note: {text}", file=sys.stderr, flush=True),
            )
        with undisturbed():
            made.spool.finish()
    lost = f", {made.counters.missing} turns missing" if made.counters.missing else ""
    print(f"{made.sweeps} sweeps, {made.spool.beams} beams{lost}: {output}")
    if made.failure is not None:
        print(f"bimfit: {made.failure}; the sweeps that came before are kept", file=sys.stderr)
        return 2
    return 0
