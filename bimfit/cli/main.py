"""The ``bimfit`` command: parses, calls the pipeline, prints, and turns errors into exit codes."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence

import typer

from bimfit import __version__
from bimfit.cli import bench, capture, compare, demo, emulate, fit, joints, live, simulate, view
from bimfit.errors import BimfitError

DONE, PARTLY, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

app = typer.Typer(
    name="bimfit",
    help="What a building joint really looks like: fit BIM to a scan and measure the as-built gap.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(demo.run)
app.command("joints")(joints.run)
app.command("fit")(fit.run)
app.command("compare")(compare.run)
app.command("simulate")(simulate.run)
app.command("capture")(capture.run)
app.command("emulate")(emulate.run)
app.command("live")(live.run)
app.command("view")(view.run)
app.command("bench")(bench.run)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"bimfit {__version__}")
        raise typer.Exit(DONE)


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", help="Print the version.", callback=_show_version, is_eager=True
    ),
    debug: bool = typer.Option(False, "--debug", help="Show the traceback of an error."),
) -> None:
    """Options that every command takes; ``--debug`` is read in :func:`main` wherever it stands."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Returns
    -------
    int
        0 done; 1 done, but a joint could not be estimated; 2 bad usage or bad input.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        status = app(words, prog_name="bimfit", standalone_mode=False)
    except BimfitError as error:
        return _refuse(str(error), debug)
    except KeyboardInterrupt:
        return _refuse("interrupted", debug=False, status=INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error of typer's
            return _refuse(f"{error.format_message()} Try: bimfit --help", debug)
        line = f"internal error ({type(error).__name__}: {error}); please report it with what --debug shows"
        return _refuse(line, debug)
    return status if isinstance(status, int) else DONE


def _refuse(line: str, debug: bool, status: int = BAD_INPUT) -> int:
    if debug:
        traceback.print_exc()
    print(f"bimfit: {' '.join(line.split())}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
