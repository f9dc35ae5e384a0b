"""The `era` command: every package's commands, put together, and how a run ends.

A package offers its commands through the entry-point group `era_haptics.commands`: a module with
`app`, a typer application whose commands appear under `era`, and `EXIT_STATUS`, the exit status
for each exception that it raises on purpose. Nothing here knows the packages by name.
"""

import errno
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points, version
from pathlib import Path
from typing import Annotated, TypeAlias

import typer
from typer.core import TyperGroup
from typer.main import get_group

from model.errors import in_our_words
from registry.plugins import failed_plugin, failure_text, package_remedy

BAD_INPUT = 2
BUG = 70  # EX_SOFTWARE of sysexits.h
INTERRUPTED = 130
READER_LEFT = 141  # what a shell reports of a program that SIGPIPE has ended

ExitStatus: TypeAlias = dict[type[BaseException], int]

# With two threads the small systems here took up to three times as long, and erratically so.
_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
    """Run the command line that the process was started with; returns the exit status."""
    for variable in _THREAD_COUNTS:
        os.environ.setdefault(variable, "1")
    # While modules load there is nothing to silence, and a KeyboardInterrupt could be swallowed.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: os._exit(INTERRUPTED))
    modules = entry_points(group="era_haptics.commands")
    return run(sys.argv[1:], modules, on_loaded=_end_in_order)


def _end_in_order() -> None:
    """Being told to end is Ctrl-C from somebody else: amplifiers are silenced before the end."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))


def run(
    arguments: Sequence[str],
    modules: Iterable[EntryPoint],
    *,
    on_loaded: Callable[[], None] = lambda: None,
) -> int:
    """Run one command line with the commands of these modules; returns the exit status.

    on_loaded is called once these are there.
    """
    debug, arguments = _take_debug(arguments)
    group, statuses = put_together(modules, debug=debug)
    try:
        on_loaded()
        status = _invoke(group, arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return READER_LEFT
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED
    except Exception as error:
        if debug:
            traceback.print_exc()
        return _report(error, statuses)
    return status


def _take_debug(arguments: Sequence[str]) -> tuple[bool, list[str]]:
    """Whether --debug stands anywhere before a `--`, and the arguments without it."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    kept = [argument for argument in arguments[:end] if argument != "--debug"]
    return len(kept) < end, [*kept, *arguments[end:]]


def put_together(modules: Iterable[EntryPoint], *, debug: bool) -> tuple[TyperGroup, ExitStatus]:
    """One group with the commands of all modules; one that cannot be loaded is left out."""
    app = typer.Typer(no_args_is_help=True)
    app.callback()(_root)
    group = _group(app)
    statuses: ExitStatus = {}
    for entry in modules:
        try:
            module = entry.load()
            commands = _group(module.app).commands
            repeated = ", ".join(sorted(commands.keys() & group.commands.keys()))
            if repeated:
                raise RuntimeError(f"another package has these commands too: {repeated}")
            statuses.update(module.EXIT_STATUS)
            group.commands.update(commands)
        except Exception as error:
            if debug:
                traceback.print_exc()
            _say(
                f"warning: skipped the commands of {entry.value}, which cannot be loaded "
                f"({type(error).__name__}: {error}); {package_remedy(entry)}"
            )
    return group, statuses


def _group(app: typer.Typer) -> TyperGroup:
    """The commands of an application; their help without rich, which would double its time."""
    app.rich_markup_mode = None
    return get_group(app)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"era-haptics {version('era-haptics')}")
        raise typer.Exit


def _root(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Say which version."),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show where an error arose; may stand anywhere.")
    ] = False,
) -> None:
    """Felt here, not there: localized vibration on large touch plates."""


def _invoke(group: TyperGroup, arguments: list[str]) -> int:
    """Run a command; the exit status is the one it asked for, or 0."""
    try:
        with group.make_context("era", arguments) as context:
            group.invoke(context)
    except typer.Exit as ending:
        return ending.exit_code
    return 0


def _report(error: Exception, statuses: ExitStatus) -> int:
    """Say in a paragraph what ended the run; returns the exit status."""
    for kind in type(error).__mro__:
        if kind in statuses:
            _say(f"error: {error}")
            return statuses[kind]
    if isinstance(error, typer.TyperException):
        return _report_usage(error)
    if isinstance(error, OSError) and error.filename is not None:
        _say(f"error: {error.filename}: {_of_system(error)}")
        return BAD_INPUT
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        _say("error: there is no room left for what is written; make some, or write elsewhere")
        return BAD_INPUT
    if failed_plugin(error) is not None:
        _say(f"error: {failure_text(error)}")
        return BAD_INPUT
    _say(
        f"error: this is a bug in era-haptics, please report it ({type(error).__name__}: {error}). "
        "Run the same command again with --debug to see where it arose"
    )
    return BUG


_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says of a file that is written, without its name."""


def _of_system(error: OSError) -> str:
    """What the system has against a file, and what to do about it."""
    path = Path(str(error.filename))
    match error.errno:
        case errno.ENOENT if not path.parent.is_dir():
            return f"there is no folder {path.parent}; make it, or name another"
        case errno.ENOENT:
            return "no such file; check its name and folder"
        case errno.EEXIST | errno.ENOTDIR:
            return "a file is there, where a folder is wanted; give another name"
        case errno.EISDIR:
            return "is a folder, where a file is wanted; give the name of a file"
        case errno.EACCES | errno.EPERM:
            return "you may not use this; get the right to, or give another name"
        case number if number in _NO_ROOM:
            return "there is no room left; make some, or write elsewhere"
        case _:
            return f"{error.strerror}; check the name and who may use it"


def _report_usage(error: typer.TyperException) -> int:
    """Say what was wrong with the command line, or the help where a command was left out."""
    message = in_our_words(error.format_message())
    context = getattr(error, "ctx", None)
    if context is None:
        _say(f"error: {message}")
    elif message == context.get_help():
        typer.echo(message, err=True)
    else:
        stop = "" if message.endswith((".", "?")) else "."
        _say(f"error: {message}{stop} See  {context.command_path} --help")
    return BAD_INPUT


def _say(text: str) -> None:
    typer.echo(f"era: {text}", err=True)
