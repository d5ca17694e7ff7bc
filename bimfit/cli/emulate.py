"""``bimfit emulate``: a virtual rangefinder that other programs open as a serial port."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, cast

import typer

from bimfit.cli.interrupts import stoppable
from bimfit.cli.options import length
from bimfit.cli.options import speed as read_speed
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.pipeline.emulate import Emulation
    from bimfit.sensor.faults import Fault

SAMPLE = "square-butt-ifc4.ifc"


def run(
    source: Path | None = typer.Argument(
        None, metavar="[SCAN|MODEL]", help="A line scan to replay, or a model; default: the packaged sample."
    ),
    seed: int = typer.Option(0, "--seed", min=0, help="Of the joint's motion and the noise."),
    joint: str | None = typer.Option(
        None, "--joint", metavar="ID|GUID,GUID", help="Of the model; default: the longest open one."
    ),
    scenario: Path | None = typer.Option(
        None, "--scenario", metavar="FILE.toml", help="What moves, and where the sensor is held."
    ),
    speed: str = typer.Option("0.05", "--speed", help="Of the sensor along the joint, m/s."),
    sigma: str | None = typer.Option(
        None, "--sigma", help="Range noise, such as 3mm, or 0 for none; default: as recorded."
    ),
    truth: Path | None = typer.Option(
        None, "--truth", metavar="FILE", help="Where the truth is written (json)."
    ),
    fault: list[str] = typer.Option(
        [], "--fault", metavar="KIND@S[:S]", help="What goes wrong, when and how long, such as unplug@5:2."
    ),
    pace: float = typer.Option(1.0, "--pace", help="Emulated seconds a second."),
    link: Path | None = typer.Option(None, "--link", metavar="PATH", help="Name of the port."),
) -> int:
    """Serve a virtual rangefinder on a pseudo-terminal, whose path is the first line, until interrupted."""
    from bimfit.pipeline.emulate import is_model, recorded_emulation
    from bimfit.sensor.emulator import Emulator
    from bimfit.sensor.noise import NO_NOISE, Noise

    with stoppable():
        try:
            faults = [_fault(text) for text in fault]
            spread = None if sigma is None else length(sigma, "--sigma")
            noise = NO_NOISE if spread == 0.0 else Noise(sigma=spread)
            if source is None or is_model(source):
                served = _model(source, scenario, seed, joint, speed, truth)
            else:
                _only_for_models(joint, scenario, truth)
                served = recorded_emulation(source)
            with Emulator(
                served.scene, speed=pace, noise=noise, faults=faults, seed=seed, link=link
            ) as device:
                _announce(device.port, served)
                while device.running:
                    time.sleep(0.2)
        except KeyboardInterrupt:
            return 0
    return 0


def _announce(port: str, served: Emulation) -> None:
    print(port, flush=True)
    # the rest goes to stderr: a script may take one line and close the pipe
    print(f"serves {served.about}; Ctrl-C ends it", file=sys.stderr)
    if served.T_world_sensor is not None:
        from scipy.spatial.transform import Rotation

        T = served.T_world_sensor
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec()]
        print("starts at --scan-pose " + ",".join(f"{x:.9g}" for x in numbers), file=sys.stderr)


def _model(
    source: Path | None, scenario: Path | None, seed: int, joint: str | None, speed: str, truth: Path | None
) -> Emulation:
    from bimfit.files import protect_inputs
    from bimfit.pipeline.emulate import model_emulation
    from bimfit.pipeline.samples import sample_model
    from bimfit.simulation.scenario import Scenario, load_scenario
    from bimfit.simulation.truth import write_truth

    model = source or sample_model(SAMPLE)
    if truth is not None:
        protect_inputs([truth], [path for path in (model, scenario) if path is not None])
    settings = load_scenario(scenario) if scenario else Scenario()
    way = read_speed(speed)
    served = model_emulation(model, settings, seed, joint=joint, speed=way)
    if truth is not None and served.truth is not None:
        write_truth([served.truth], truth, model=model)
    return served


def _only_for_models(joint: str | None, scenario: Path | None, truth: Path | None) -> None:
    for name, value in (("--joint", joint), ("--scenario", scenario), ("--truth", truth)):
        if value is not None:
            raise ConfigError(f"{name} is for models", remedy="a scan is replayed as it is")


def _fault(text: str) -> Fault:
    from bimfit.sensor.faults import KINDS, Fault, Kind

    found = re.fullmatch(r"(\w+)@(\d+(?:\.\d+)?)(?::(\d+(?:\.\d+)?))?", text)
    if not found or found.group(1) not in KINDS:
        raise ConfigError(f"--fault {text}: not a fault", remedy=f"KIND@S[:S] of {', '.join(KINDS)}")
    kind = cast("Kind", found.group(1))
    return Fault(float(found.group(2)), kind, float(found.group(3) or 0.5))
