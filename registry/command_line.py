"""Command line: joins the commands of several modules, runs one, and turns errors into an exit
status.

`era_haptics.command` lists the modules with the commands of `era`.
"""

import errno
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeAlias

import typer
from typer.core import TyperGroup
from typer.main import get_group, get_install_completion_arguments

from registry.files import posix_needed
from registry.plugins import failed_plugin, failure_text
from registry.streams import protect_streams
from registry.wording import reworded

SECTIONS = {
    "Try": ("demo", "sim"),
    "Plate": (
        "config",
        "plate",
        "table",
        "layout",
        "calibrate",
        "rig",
        "design",
        "content",
        "outputs",
        "measure",
    ),
    "Run": (
        "daemon",
        "status",
        "arm",
        "disarm",
        "stop",
        "clear",
        "touch",
        "play",
        "strength",
        "watch",
        "gateway",
        "reload",
        "report",
    ),
    "Amplifier": ("amp", "soft-amp"),
}
"""Commands by section, in the order of help and reference; rarely used commands are last."""

# Exit statuses
BAD_INPUT = 2
BUG = 70  # EX_SOFTWARE of sysexits.h
INTERRUPTED = 130  # as a shell reports SIGINT
BROKEN_PIPE = 141  # as a shell reports SIGPIPE

ExitStatus: TypeAlias = dict[type[BaseException], int]


class CommandModule(Protocol):
    """A module that provides commands."""

    app: typer.Typer
    """Commands to add to `era`. Groups with the same name in several modules become one group."""
    EXIT_STATUS: ExitStatus
    """Exit status for each class of exception that its commands raise on purpose."""


LoadModules: TypeAlias = Callable[[], Sequence[CommandModule]]
"""Imports modules with commands, which takes a second."""

# With two threads, small systems take up to three times as long, with wide variation.
_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main(load: LoadModules) -> int:
    """Run the command line of this process; return its exit status.

    load: called after the signal handlers are set.
    """
    for variable in _THREAD_COUNTS:
        os.environ.setdefault(variable, "1")
    # Pictures go to files; a notebook passes its own backend to child processes, such as `!era`.
    os.environ["MPLBACKEND"] = "agg"
    protect_streams()
    # End immediately while modules load: nothing is armed, and an import could swallow a
    # KeyboardInterrupt.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: os._exit(INTERRUPTED))
    instruction = os.environ.get(COMPLETE)
    if instruction:
        return _complete(instruction, load)
    return run(sys.argv[1:], load, on_loaded=_interrupt_on_signals)


COMPLETE = "_ERA_COMPLETE"
"""Environment variable with the request of a shell's completion script."""


def _complete(instruction: str, load: LoadModules) -> int:
    """Print completions of the command line being typed in a shell; return the exit status."""
    from typer.completion import shell_complete

    group, _ = join_commands(load())  # also registers the shells that typer supports
    return shell_complete(group, {}, "era", COMPLETE, instruction)


def _interrupt_on_signals() -> None:
    """Treat SIGTERM as Ctrl-C, so that amplifiers are silenced before the process ends."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))


def run(
    arguments: Sequence[str],
    load: LoadModules,
    *,
    on_loaded: Callable[[], None] = lambda: None,
) -> int:
    """Run a command line; return the exit status.

    on_loaded: called when the modules with the commands are loaded.
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    options = [argument for argument in arguments[:end] if argument != "--debug"]
    debug = len(options) < end
    arguments = [*options, *arguments[end:]]
    group, statuses = join_commands(load())
    try:
        on_loaded()
        status = _invoke(group, arguments)
        print(end="", flush=True)  # sys.stdout can be missing or closed
    except BrokenPipeError:
        # Otherwise Python would report the broken pipe again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED
    except Exception as error:
        if debug:
            traceback.print_exc()
        return _report(error, statuses)
    return status


class _Commands(TyperGroup):
    """The commands of `era` by section; commands without a section come last."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names in the order of help and reference."""
        return [name for names in self.sections().values() for name in names]

    def sections(self) -> dict[str, list[str]]:
        """Return the names of the commands by section title."""
        remaining = set(self.commands)
        sections = {}
        for title, names in SECTIONS.items():
            sections[title] = [name for name in names if name in self.commands]
            remaining.difference_update(names)
        sections["Others"] = sorted(remaining)
        return sections

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Find a command. For the name of an option, such as `era version`, suggest the option."""
        option = f"--{args[0]}"
        if any(option in parameter.opts for parameter in self.get_params(ctx)):
            ctx.fail(f"No such command {args[0]!r}. Did you mean {option}?")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands of each section with their summaries."""
        width = max(len(name) for name in self.commands)
        limit = formatter.width - width - 6
        for title, names in self.sections().items():
            rows = []
            for name in names:
                summary = self.commands[name].get_short_help_str(limit)
                rows.append((name.ljust(width), summary))
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def join_commands(modules: Iterable[CommandModule]) -> tuple[TyperGroup, ExitStatus]:
    """Return a group with the commands of all modules, and the exit status by exception class."""
    app = typer.Typer(cls=_Commands, no_args_is_help=True)
    app.callback()(_root)
    group = _group(app)
    group.params += get_install_completion_arguments()
    statuses: ExitStatus = {}
    for module in modules:
        statuses.update(module.EXIT_STATUS)
        for word, command in _group(module.app).commands.items():
            joined = group.commands.setdefault(word, command)
            if isinstance(joined, TyperGroup) and isinstance(command, TyperGroup):
                joined.commands.update(command.commands)
    return group, statuses


@cache
def _group(app: typer.Typer) -> TyperGroup:
    """Return the commands of an application; no rich markup, which doubles the time of help."""
    app.rich_markup_mode = None
    return get_group(app)


def _show_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(f"era-haptics {version('era-haptics')}")
        raise typer.Exit


def _root(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error; allowed anywhere.")
    ] = False,
) -> None:
    """Haptic feedback for several fingers on one large touch plate."""


def _invoke(group: TyperGroup, arguments: list[str]) -> int:
    """Run a command; return its exit status, 0 unless it states one."""
    try:
        with group.make_context("era", arguments) as context:
            group.invoke(context)
    except typer.Exit as ending:
        return ending.exit_code
    return 0


def _report(error: Exception, statuses: ExitStatus) -> int:
    """Print the error that ended the command; return the exit status."""
    for kind in type(error).__mro__:
        if kind in statuses:
            _print_error(f"error: {error}")
            return statuses[kind]
    if isinstance(error, typer.TyperException):
        return _report_usage(error)
    if isinstance(error, OSError) and error.filename is not None:
        _print_error(f"error: {error.filename}: {_file_error(error)}")
        return BAD_INPUT
    if isinstance(error, OSError) and error.errno in _NO_OUTPUT:
        _print_error("error: standard output cannot be written; redirect it to a file")
        return BAD_INPUT
    if isinstance(error, OSError) and error.errno in _DISK_FULL:
        _print_error("error: disk full; free some space, or write elsewhere")
        return BAD_INPUT
    if failed_plugin(error) is not None:
        _print_error(f"error: {failure_text(error)}")
        return BAD_INPUT
    platform_problem = posix_needed(error)
    if platform_problem:
        _print_error(f"error: {platform_problem}")
        return BAD_INPUT
    _print_error(
        f"error: this is a bug in era-haptics, please report it ({type(error).__name__}: {error}). "
        "Run the same command with --debug to see the traceback"
    )
    return BUG


_NO_OUTPUT = (errno.EBADF, errno.EIO)
"""Errors when writing to a stream that is open for reading only, or to a closed terminal."""

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors when writing to a full disk; these have no file name."""


def _file_error(error: OSError) -> str:
    """Return the description of a file error, with its remedy."""
    path = Path(str(error.filename))
    match error.errno:
        case errno.ENOENT if not path.parent.is_dir():
            return f"no such folder {path.parent}; create it, or choose another"
        case errno.ENOENT:
            return "no such file; check its path"
        case errno.EEXIST | errno.ENOTDIR:
            return "must be a folder, got a file; choose another name"
        case errno.EISDIR:
            return "must be a file, got a folder; choose the name of a file"
        case errno.EACCES | errno.EPERM:
            return "permission denied; change the permissions, or choose another name"
        case number if number in _DISK_FULL:
            return "disk full; free some space, or write elsewhere"
        case _:
            return f"{error.strerror}; check the path and its permissions"


def _report_usage(error: typer.TyperException) -> int:
    """Print a usage error, or the help if there is no command; return the exit status."""
    message = reworded(error.format_message())
    context = getattr(error, "ctx", None)
    if context is None:
        _print_error(f"error: {message}")
    elif message == context.get_help():
        typer.echo(message, err=True)
    else:
        stop = "" if message.endswith((".", "?")) else "."
        _print_error(f"error: {message}{stop} See {context.command_path} --help")
    return BAD_INPUT


def _print_error(text: str) -> None:
    typer.echo(f"era: {text}", err=True)
