"""``bimfit compare``: the same slices through every method."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bimfit.cli.choosing import choosing
from bimfit.cli.options import build_config
from bimfit.cli.placing import placing
from bimfit.cli.progress import terminal_progress

if TYPE_CHECKING:
    from bimfit.bim.selection import Selection
    from bimfit.pipeline.placing import Placing


@choosing
@placing
def run(
    choice: Selection,
    where: Placing,
    model: Path = typer.Argument(..., metavar="MODEL.ifc", help="The building model."),
    scan: Path = typer.Argument(..., metavar="SCAN", help="Line scan or point cloud."),
    output: Path = typer.Option(
        ..., "-o", "--output", metavar="DIR", help="Where the table and the plots go."
    ),
    methods: str | None = typer.Option(
        None, "--methods", metavar="A,B,...", help="Which methods; default: all."
    ),
    paper: bool = typer.Option(
        False, "--paper", help="Add the method as printed; without --methods, beside grcsm alone."
    ),
    truth: Path | None = typer.Option(
        None, "--truth", metavar="FILE", help="Truth to measure errors against."
    ),
    spacing: str | None = typer.Option(None, "--spacing", help="Distance between stations, such as 10mm."),
    config: Path | None = typer.Option(None, "--config", metavar="FILE.toml", help="Settings."),
) -> int:
    """Run the same slices through every method and compare error, time and failures."""
    from bimfit.pipeline.compare import DEFAULT_METHODS, compare, comparison_table, write_comparison
    from bimfit.pipeline.output import check_folder

    names = (
        DEFAULT_METHODS
        if methods is None
        else tuple(name.strip() for name in methods.split(",") if name.strip())
    )
    if paper:
        names = ("grcsm", "paper") if methods is None else (*(n for n in names if n != "paper"), "paper")
    settings = build_config(config, spacing=spacing)
    check_folder(output)
    with terminal_progress() as progress:
        result = compare(
            model,
            scan,
            settings,
            methods=names,
            truth=truth,
            joints=choice,
            placing=where,
            progress=progress,
        )
        write_comparison(result, output)
    print(comparison_table(result))
    print(f"table and plots in {output}")
    return 0
