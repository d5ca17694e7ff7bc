"""``bimfit demo``: the paper's experiment, from nothing."""

from __future__ import annotations

from pathlib import Path

import typer

from bimfit.cli.progress import terminal_progress


def run(
    output: Path = typer.Option(
        Path("bimfit-demo"), "-o", "--output", metavar="DIR", help="Where the files go."
    ),
    joints: int = typer.Option(20, "--joints", min=1, help="Random joints in the accuracy table."),
    seed: int = typer.Option(0, "--seed", min=0, help="Seed of the first joint."),
    report: bool = typer.Option(True, help="Write report.html."),
) -> int:
    """Scan the packaged joint virtually, fit it, measure its gap, and compare methods."""
    from bimfit.pipeline.demo import demo
    from bimfit.pipeline.output import check_folder

    check_folder(output)
    with terminal_progress() as progress:
        result = demo(output, joints=joints, seed=seed, report=report, progress=progress)
    print("Accuracy on the paper's reference scenario\n")
    print(result.accuracy)
    print(f"stations without an estimate: {result.lost}; estimates more than 10 mm off: {result.far}")
    print(result.times)
    print("\nMethods on the same slices of one joint\n")
    print(result.comparison)
    print(f"\nLook at {output}:")
    for path in result.files:
        print(f"  {path.name}")
    return 0
