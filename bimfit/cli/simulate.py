"""``bimfit simulate``: a virtual scan."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bimfit.cli.choosing import choosing

if TYPE_CHECKING:
    from bimfit.bim.selection import Selection


@choosing
def run(
    choice: Selection,
    model: Path = typer.Argument(..., metavar="MODEL.ifc", help="The building model."),
    output: Path = typer.Option(
        ..., "-o", "--output", metavar="SCAN", help="Line scan to write (csv or npz)."
    ),
    scenario: Path | None = typer.Option(
        None, "--scenario", metavar="FILE.toml", help="What moves, and the sensor."
    ),
    seed: int = typer.Option(0, "--seed", min=0, help="The same seed gives the same scan."),
    truth: Path | None = typer.Option(
        None, "--truth", metavar="FILE", help="Where the truth is written (json)."
    ),
) -> int:
    """Scan joints whose components have moved at random, with a virtual rangefinder.

    All joints that the options choose are scanned; without any, the longest open one.
    """
    from bimfit.files import protect_inputs
    from bimfit.pipeline.simulate import simulate
    from bimfit.scan.formats import write_scan
    from bimfit.simulation.scenario import Scenario, load_scenario
    from bimfit.simulation.truth import write_truth

    inputs = [path for path in (model, scenario, choice.pairs) if path is not None]
    protect_inputs([path for path in (output, truth) if path is not None], inputs)
    settings = load_scenario(scenario) if scenario else Scenario()
    scan, truths = simulate(model, settings, seed, joints=choice, told=_note)
    write_scan(scan, output)
    if truth is not None:
        write_truth(truths, truth, model=model, scan=output)
    for one in truths:
        pair = ",".join(one.elements)
        print(f"{one.id}: {one.kind} {pair}, designed {one.width * 1e3:.1f} mm, {len(one.stations)} stations")
    print(f"{len(scan)} beams in {len(scan.sweeps)} sweeps: {output}")
    return 0


def _note(text: str) -> None:
    print(f"bimfit: note: {text}", file=sys.stderr)
