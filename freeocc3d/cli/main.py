"""The ``freeocc3d`` command: assembles its commands, and turns errors into one line. Heavy imports happen inside the
commands."""

from __future__ import annotations

import io
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from .. import __version__
from ..core.errors import FreeOccError, Interrupted, is_interrupt, printable
from . import models
from .check import check
from .console import flag, say, show
from .demo import demo
from .evaluate import evaluate
from .export import export
from .ground_truth_command import ground_truth
from .info import info
from .inspect import inspect
from .list import list_backends
from .objects import objects
from .query import query
from .reconstruct import reconstruct
from .refine import refine
from .relabel import relabel
from .scale import scale
from .stopping import Stopping
from .upright import upright
from .view import view


class _Commands(TyperGroup):
    """Takes interrupts out before typer does, which would print "Aborted." and exit with 1."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except Exception as error:
            if isinstance(error, FreeOccError) or not is_interrupt(error):
                raise
            raise Interrupted("Stopped.") from error
        except KeyboardInterrupt as error:
            raise Interrupted("Stopped.") from error


app = typer.Typer(
    cls=_Commands,
    help="Turns a captured indoor scan into an occupancy map that answers words. It needs no training and no poses.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, flag("--version", "Print the version.")] = False,
    debug: Annotated[bool, flag("--debug", "Show the traceback of an error. May also follow a command.")] = False,
) -> None:
    if version:
        show(__version__)
        raise typer.Exit


for _command in (
    demo,
    inspect,
    reconstruct,
    query,
    objects,
    view,
    info,
    check,
    export,
    refine,
    relabel,
    scale,
    upright,
    evaluate,
    ground_truth,
):
    app.command()(_command)
app.command("list")(list_backends)
app.add_typer(models.app, name="models")


def main(arguments: list[str] | None = None) -> None:
    """Run the command; a known error is one line on stderr and exit code 1, or with --debug its traceback. After
    SIGTERM and SIGHUP it is 128 plus the signal's number."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    _prepare_streams()
    stopping = Stopping()
    try:
        with stopping:
            try:
                app(args=[argument for argument in arguments if argument != "--debug"], prog_name="freeocc3d")
            finally:
                sys.stdout.flush()
    except (FreeOccError, OSError) as error:
        if debug:
            raise
        say(f"freeocc3d: {_sentence(error)}")
        if isinstance(error, OSError):  # what is left to print would fail again when Python ends
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        raise SystemExit(stopping.status) from None


def _prepare_streams() -> None:
    """Open what a service has closed, lest a file take its number and libraries print into it. What a terminal cannot
    show is written as escapes."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if number else "r"))  # noqa: SIM115
    for stream, errors in ((sys.stdin, "replace"), (sys.stdout, "backslashreplace")):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=errors)


def _sentence(error: FreeOccError | OSError) -> str:
    """What to tell. An OSError that no command has turned into its own sentence is of the answer, if it names no
    file."""
    if isinstance(error, FreeOccError):
        return " ".join(str(error).split())
    reason = printable(error.strerror or str(error))
    if error.filename is None:
        return f"The answer cannot be written: {reason}."
    return f"{printable(str(error.filename))} cannot be used: {reason}."


if __name__ == "__main__":
    main()
