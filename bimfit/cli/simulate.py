"""``bimfit simulate``: a virtual scan."""

from __future__ import annotations

from pathlib import Path

import typer


def run(
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
    joint: list[str] = typer.Option(
        [],
        "--joint",
        metavar="ID|GUID,GUID",
        help="A joint to scan; may be repeated. Default: the longest open one.",
    ),
) -> int:
    """Scan a joint whose components have moved at random, with a virtual rangefinder."""
    from bimfit.files import protect_inputs
    from bimfit.pipeline.simulate import simulate
    from bimfit.scan.formats import write_scan
    from bimfit.simulation.scenario import Scenario, load_scenario
    from bimfit.simulation.truth import write_truth

    inputs = [path for path in (model, scenario) if path is not None]
    protect_inputs([path for path in (output, truth) if path is not None], inputs)
    settings = load_scenario(scenario) if scenario else Scenario()
    scan, truths = simulate(model, settings, seed, joints=joint)
    write_scan(scan, output)
    if truth is not None:
        write_truth(truths, truth, model=model, scan=output)
    for one in truths:
        pair = ",".join(one.elements)
        print(f"{one.id}: {one.kind} {pair}, designed {one.width * 1e3:.1f} mm, {len(one.stations)} stations")
    print(f"{len(scan)} beams in {len(scan.sweeps)} sweeps: {output}")
    return 0
