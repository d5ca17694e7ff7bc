"""``bimfit bench``: the published tables, made again."""

from __future__ import annotations

from pathlib import Path

import typer

from bimfit.cli.progress import terminal_progress


def run(
    suite: str = typer.Option(
        "accuracy",
        "--suite",
        metavar="NAME",
        help="accuracy, refusal, matcher, matcher-3d, scan, bim, back or fuzz.",
    ),
    joints: int = typer.Option(
        100, "--joints", min=1, help="Random joints (matcher-3d: starts; fuzz: files)."
    ),
    seed: int = typer.Option(1000, "--seed", min=0, help="Seed of the first joint."),
    case: str | None = typer.Option(
        None,
        "--case",
        metavar="NAME",
        help="Of accuracy, refusal: this one alone, with all joints.",
    ),
    json_file: Path | None = typer.Option(
        None, "--json", metavar="FILE", help="Write the figures there, too."
    ),
) -> int:
    """Measure accuracy and speed on the reference scenario and print the tables."""
    from bimfit.errors import ConfigError
    from bimfit.files import write_text
    from bimfit.pipeline.bench import SUITES, bench
    from bimfit.pipeline.results import to_json

    if suite not in SUITES:
        raise ConfigError(f"unknown suite {suite}", remedy=f"choose from {', '.join(SUITES)}")
    if case is not None and suite not in ("accuracy", "refusal"):
        raise ConfigError(f"the suite {suite} has no cases", remedy="leave --case out")
    with terminal_progress() as progress:
        result = bench(suite, joints=joints, seed=seed, progress=progress, case=case)
    if json_file is not None:
        write_text(json_file, to_json({"suite": suite, "joints": joints, "seed": seed, **result.data}))
    print(result.text)
    return 0
