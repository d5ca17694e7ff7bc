"""``bimfit emulate``: a virtual rangefinder that other programs open as a serial port."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import typer

from bimfit.cli.interrupts import stoppable
from bimfit.cli.options import length
from bimfit.cli.options import speed as read_speed
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.pipeline.emulate import Emulation
    from bimfit.sensor.dialogue import Speaker
    from bimfit.sensor.faults import Fault
    from bimfit.sensor.models import Model

SAMPLE = "square-butt-ifc4.ifc"
LEFT = {"resting": "", "lit": "BM", "timing": "TM0", "streaming": "MD{:04d}{:04d}01000"}


def run(
    source: Path | None = typer.Argument(
        None,
        metavar="[SCAN|MODEL]",
        help="A line scan or a SCIP dialogue to replay, or a model; default: the packaged sample.",
    ),
    seed: int = typer.Option(0, "--seed", min=0, help="Of the joint's motion, the noise and the faults."),
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
    device: str | None = typer.Option(
        None,
        "--device",
        metavar="NAME",
        help="ug01, urg-04lx, ubg-04lx or utm-30lx; default: that of the dialogue, else ug01.",
    ),
    left: str | None = typer.Option(
        None, "--left", metavar="STATE", help="How it was left: resting, lit, timing or streaming."
    ),
    fault: list[str] = typer.Option(
        [], "--fault", metavar="KIND@S[:S]", help="What goes wrong, when and how long, such as unplug@5:2."
    ),
    fault_every: float | None = typer.Option(
        None, "--fault-every", metavar="S", help="Passing faults of all kinds, so often on average."
    ),
    pace: float = typer.Option(1.0, "--pace", help="Emulated seconds a second."),
    link: Path | None = typer.Option(None, "--link", metavar="PATH", help="Name of the port."),
) -> int:
    """Serve a virtual rangefinder on a pseudo-terminal, whose path is the first line, until interrupted."""
    from bimfit.sensor.emulator import Emulator

    with stoppable():
        try:
            kind = _kind(device)
            _check_left(left)
            served = _served(source, scenario, seed, joint, speed, truth, kind.parameters)
            with Emulator(
                served.scene,
                speed=pace,
                noise=_noise(sigma),
                faults=_faults(fault, fault_every, seed),
                seed=seed,
                link=link,
                **_device(kind, served.speaker if device is None else None, left),
            ) as port:
                _announce(port.port, served)
                while port.running:
                    time.sleep(0.2)
        except KeyboardInterrupt:
            return 0
    return 0


def _announce(port: str, served: Emulation) -> None:
    print(port, flush=True)
    # the rest goes to stderr: a script may take one line and close the pipe
    print(f"serves {served.about}; Ctrl-C ends it", file=sys.stderr)
    if served.T_world_sensor is not None:
        import numpy as np
        from scipy.spatial.transform import Rotation

        T = served.T_world_sensor
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec()]
        # whole micrometres also at map coordinates
        text = ",".join(f"{x + 0.0:.9f}".rstrip("0").rstrip(".") for x in np.round(numbers, 9))
        print(f"starts at --scan-pose {text}", file=sys.stderr, flush=True)


def _kind(name: str | None) -> Model:
    from bimfit.sensor.models import MODELS

    if name is not None and name not in MODELS:
        raise ConfigError(f"--device {name}: unknown", remedy=f"choose from {', '.join(MODELS)}")
    return MODELS[name or "ug01"]


def _check_left(left: str | None) -> None:
    if left is not None and left not in LEFT:
        raise ConfigError(f"--left {left}: unknown", remedy=f"choose from {', '.join(LEFT)}")


def _device(kind: Model, speaker: Speaker | None, left: str | None) -> dict[str, Any]:
    """What the emulator is told of the device: a recorded one is as it was when it was recorded."""
    has = (speaker and speaker.parameters) or kind.parameters
    lit = "lit" if speaker is not None and speaker.lit else "resting"
    request = LEFT[left or lit].format(has.amin, has.amax)
    waking = "SCIP2.0\n" if kind.scip1 and request else ""
    return {
        "parameters": has,
        "identity": (speaker and speaker.identity) or kind.identity,
        "scip1": kind.scip1,
        "told": f"{waking}{request}\n".encode("ascii"),
    }


def _noise(sigma: str | None) -> Any:
    from bimfit.sensor.noise import NO_NOISE, Noise

    spread = None if sigma is None else length(sigma, "--sigma")
    return NO_NOISE if spread == 0.0 else Noise(sigma=spread)


def _served(
    source: Path | None,
    scenario: Path | None,
    seed: int,
    joint: str | None,
    speed: str,
    truth: Path | None,
    parameters: Any,
) -> Emulation:
    from bimfit.pipeline.emulate import is_model, model_emulation, recorded_emulation
    from bimfit.pipeline.samples import sample_model
    from bimfit.simulation.scenario import Scenario, load_scenario
    from bimfit.simulation.truth import write_truth

    if source is not None and not is_model(source):
        for name, value in (("--joint", joint), ("--scenario", scenario), ("--truth", truth)):
            if value is not None:
                raise ConfigError(f"{name} is for models", remedy="a scan is replayed as it is")
        return recorded_emulation(source, parameters)
    model = source or sample_model(SAMPLE)
    if truth is not None:
        from bimfit.files import protect_inputs

        protect_inputs([truth], [path for path in (model, scenario) if path is not None])
    settings = load_scenario(scenario) if scenario else Scenario()
    served = model_emulation(model, settings, seed, joint=joint, speed=read_speed(speed))
    if truth is not None and served.truth is not None:
        write_truth([served.truth], truth, model=model)
    return served


def _faults(texts: list[str], every: float | None, seed: int) -> Any:
    from bimfit.sensor.faults import now_and_then

    if every is None:
        return [_fault(text) for text in texts]
    if texts:
        raise ConfigError("--fault and --fault-every exclude one another", remedy="give one of them")
    return now_and_then(every, seed)


def _fault(text: str) -> Fault:
    from bimfit.sensor.faults import KINDS, Fault, Kind

    found = re.fullmatch(r"(\w+)@(\d+(?:\.\d+)?)(?::(\d+(?:\.\d+)?))?", text)
    if not found or found.group(1) not in KINDS:
        raise ConfigError(f"--fault {text}: not a fault", remedy=f"KIND@S[:S] of {', '.join(KINDS)}")
    kind = cast("Kind", found.group(1))
    return Fault(float(found.group(2)), kind, float(found.group(3) or 0.5))
