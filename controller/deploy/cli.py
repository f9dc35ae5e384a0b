"""`era systemd`: the daemon as a system service."""

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
    from controller.deploy.permissions import Permissions

app = typer.Typer()
systemd_app = typer.Typer(no_args_is_help=True, help="Run the daemon as a system service.")
app.add_typer(systemd_app, name="systemd")

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2}


@systemd_app.callback()
def _only_commands() -> None:
    """Run the daemon as a system service."""


@systemd_app.command()
def install(
    config: Annotated[Path, typer.Argument(metavar="[CONFIG]", help="The daemon's file.")] = Path(
        "/etc/era-haptics/daemon.yaml"
    ),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the files without writing them.")
    ] = False,
    root: Annotated[
        Path, typer.Option(help="Install below this folder, e.g. of a system image.")
    ] = Path("/"),
) -> None:
    """Install a hardened systemd unit, its user and udev rules. Prints what to run next.

    The unit allows only the devices and networks that the daemon's file uses.
    """
    from controller.deploy.files import SERVICE_NAME, service_files

    config = config.absolute()
    files = service_files(config, _era_command(), _permissions(config))
    if dry_run:
        for path, text in files.items():
            print(f"# ---- {path}\n{text}")
    else:
        installed = {root / path.relative_to("/"): text for path, text in files.items()}
        try:
            _write_all(installed)
        except PermissionError as error:
            raise InputError(
                f"{error.filename}: no permission to write; run with sudo, install elsewhere with "
                "--root, or print the files with --dry-run"
            ) from error
        for path in installed:
            print(f"Wrote {path}")
    print(
        "Next, as root:\n"
        f"  systemd-sysusers && usermod -aG {SERVICE_NAME} YOU   # may arm after logging in again\n"
        "  udevadm control --reload && udevadm trigger\n"
        f"  era daemon {config} --check\n"
        f"  systemctl daemon-reload && systemctl enable --now {SERVICE_NAME}\n"
        f"  systemctl status {SERVICE_NAME}"
    )


def _write_all(files: Mapping[Path, str]) -> None:
    """Write all files or none; raises OSError with the name of the file that failed."""
    from model.files.array_file import whole_or_nothing

    with ExitStack() as written:
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = written.enter_context(whole_or_nothing(path))
            stream.write(text.encode())
            stream.flush()  # before any file is replaced, so that a full disk changes nothing


def _permissions(config: Path) -> "Permissions":
    """Permissions that a daemon's file requires; all of them if it does not exist yet."""
    from controller.deploy.permissions import Permissions, required_permissions

    if not config.exists():
        print(f"{config}: not found; the unit allows every kind of device", file=sys.stderr)
        return Permissions()
    from controller.daemon.config import load_daemon_config

    loaded = load_daemon_config(config)
    return required_permissions(loaded.urls.values(), [touch.url for touch in loaded.touch])


def _era_command() -> Path:
    """The path of the installed `era` command."""
    beside = Path(sys.executable).with_name("era")
    found = beside if os.access(beside, os.X_OK) else Path(shutil.which("era") or "")
    if not found.is_absolute():
        raise InputError(
            f"era: command not found beside {sys.executable} or in PATH; install it with pip"
        )
    return found
