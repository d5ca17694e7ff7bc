"""The ``bimfit`` command: parses, calls the pipeline, prints, and turns errors into exit codes."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Iterator, Sequence

import typer

from bimfit import __version__
from bimfit.cli import (
    bench,
    capture,
    compare,
    convert,
    demo,
    emulate,
    fit,
    joints,
    live,
    report,
    simulate,
    teach,
    view,
)
from bimfit.cli.help import GroupedCommand
from bimfit.errors import BimfitError
from bimfit.sensor.exits import termination_raises

CACHE_OFF = "BIMFIT_NO_CACHE"
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
app.command("demo", cls=GroupedCommand)(demo.run)
app.command("joints", cls=GroupedCommand)(joints.run)
app.command("fit", cls=GroupedCommand)(fit.run)
app.command("compare", cls=GroupedCommand)(compare.run)
app.command("simulate", cls=GroupedCommand)(simulate.run)
app.command("convert", cls=GroupedCommand)(convert.run)
app.command("capture", cls=GroupedCommand)(capture.run)
app.command("emulate", cls=GroupedCommand)(emulate.run)
app.command("live", cls=GroupedCommand)(live.run)
app.command("view", cls=GroupedCommand)(view.run)
app.command("report", cls=GroupedCommand)(report.run)
app.command("teach", cls=GroupedCommand)(teach.run)
app.command("bench", cls=GroupedCommand)(bench.run)


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
    no_cache: bool = typer.Option(
        False, "--no-cache", help="Read models and find joints anew; keep nothing for the next run."
    ),
) -> None:
    """Options that every command takes; the last two are read in :func:`main` wherever they stand."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Returns
    -------
    int
        0 done; 1 done, but a joint could not be estimated; 2 bad usage or bad input.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    no_cache = "--no-cache" in words
    words = [word for word in words if word not in ("--debug", "--no-cache")] or ["--help"]
    try:
        with termination_raises(), _without_cache() if no_cache else contextlib.nullcontext():
            status = app(words, prog_name="bimfit", standalone_mode=False)
            if sys.stdout is not None:
                sys.stdout.flush()  # a full disk is found out here, not on the way out
    except BimfitError as error:
        return _refuse(str(error), debug)
    except KeyboardInterrupt:
        return _refuse("interrupted", debug=False, status=INTERRUPTED)
    except BrokenPipeError:
        _write_no_more()
        return DONE
    except OSError as error:
        _write_no_more()
        what = f"{error.filename}: cannot be used" if error.filename else "the output cannot be written"
        return _refuse(f"{what}: {error.strerror or error}", debug)
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error of typer's
            return _refuse(f"{error.format_message().rstrip('.')}; try bimfit --help", debug)
        line = f"internal error ({type(error).__name__}: {error}); please report it with what --debug shows"
        return _refuse(line, debug)
    if status == INTERRUPTED:  # typer takes Ctrl-C for itself
        return _refuse("interrupted", debug=False, status=INTERRUPTED)
    return status if isinstance(status, int) else DONE


def _write_no_more() -> None:
    """Let Python's own flush at the end go nowhere."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def _without_cache() -> Iterator[None]:
    """Keep the user's cache out of use, in child processes too."""
    before = os.environ.get(CACHE_OFF)
    os.environ[CACHE_OFF] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[CACHE_OFF]
        else:
            os.environ[CACHE_OFF] = before


def _refuse(line: str, debug: bool, status: int = BAD_INPUT) -> int:
    if debug:
        traceback.print_exc()
    print(f"bimfit: {' '.join(line.split())}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
