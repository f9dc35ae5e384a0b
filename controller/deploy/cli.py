"""`era systemd`: the daemon as a service of the system."""

import os
import shutil
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.errors import InputError

if TYPE_CHECKING:
    from controller.deploy.needs import Needs

app = typer.Typer()
systemd_app = typer.Typer(no_args_is_help=True, help="Run the daemon as a service of the system.")
app.add_typer(systemd_app, name="systemd")

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2}


@systemd_app.callback()
def _only_commands() -> None:
    """Run the daemon as a service of the system."""


@systemd_app.command()
def install(
    config: Annotated[Path, typer.Argument(metavar="[CONFIG]", help="The daemon's file.")] = Path(
        "/etc/era-haptics/daemon.yaml"
    ),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the files and write none.")
    ] = False,
    root: Annotated[
        Path, typer.Option(help="Write below this folder, as for an image of a system.")
    ] = Path("/"),
) -> None:
    """Write a hardened unit, and say what to run then.

    With it come its user and the rights to its devices.

    What the unit allows follows from the daemon's file, where that is there.
    """
    from controller.deploy.files import NAME, service_files

    config = config.absolute()
    files = service_files(config, _era(), _needs(config))
    if dry_run:
        for file in files:
            print(f"# ---- {file.path}\n{file.text}")
        _print_next(NAME, config)
        return
    texts = {root / file.path.relative_to("/"): file.text for file in files}
    try:
        _write(texts)
    except PermissionError as error:
        raise InputError(
            f"{error.filename}: you may not write this; run it with sudo, give another folder with "
            "--root, or see with --dry-run what it would write"
        ) from error
    for path in texts:
        print(f"Wrote {path}")
    _print_next(NAME, config)


def _write(texts: Mapping[Path, str]) -> None:
    """Write all the files or, where one cannot be written, none; raises OSError with its name."""
    from model.files.array_file import whole_or_nothing

    with ExitStack() as written:
        for path, text in texts.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = written.enter_context(whole_or_nothing(path))
            stream.write(text.encode())
            stream.flush()  # before any takes its place: a full disk must show by then


def _needs(config: Path) -> "Needs":
    """What a configuration needs; everything where there is none yet."""
    from controller.deploy.needs import Needs, needs_of

    if not config.exists():
        print(
            f"{config} is not there yet, so the unit allows every kind of device", file=sys.stderr
        )
        return Needs()
    from controller.daemon.config import load_daemon_config

    loaded = load_daemon_config(config)
    return needs_of(loaded.urls.values(), [touch.url for touch in loaded.touch])


def _era() -> Path:
    """The installed command; one that lies in a home folder cannot be seen by the service."""
    beside = Path(sys.executable).with_name("era")
    found = beside if os.access(beside, os.X_OK) else Path(shutil.which("era") or "")
    if not found.is_absolute():
        raise InputError(
            f"there is no era command for the service to run, neither beside {sys.executable} nor "
            "in PATH; install it with  pip install era-haptics"
        )
    return found


def _print_next(name: str, config: Path) -> None:
    print(
        "Next, as root:\n"
        f"  systemd-sysusers && usermod -aG {name} YOU   # who shall arm; log in again then\n"
        "  udevadm control --reload && udevadm trigger\n"
        f"  era daemon {config} --check\n"
        f"  systemctl daemon-reload && systemctl enable --now {name}\n"
        f"  systemctl status {name}"
    )
