"""The controller's commands of `era`; `gateway` is defined here."""

import os
from pathlib import Path
from typing import Annotated

import typer

from controller.api.summaries import SUMMARIES
from controller.cli.daemon_cli import (
    DASHBOARD,
    DashboardCommand,
    arm,
    daemon,
    layout_app,
    of_method,
    reload,
    status,
    strength,
    touch,
    watch,
)
from controller.cli.demo import demo
from drivers.by_hand import cli as by_hand
from model.errors import InputError


def gateway(
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on; port 0: any free one.")
    ] = DASHBOARD,
    socket: Annotated[
        Path | None, typer.Option(help="The daemon's socket (default: the usual one).")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(help="File (mode 600) with the token (default: a random one)."),
    ] = None,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Additional host name to accept (repeatable)."),
    ] = None,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ORIGIN",
            help="Additional origin to accept, https://HOST[:PORT] (repeatable).",
        ),
    ] = None,
) -> None:
    """Serve the daemon's API and the dashboard to browsers.

    Prints the URL to open, with the token. An operational interface, not an emergency stop.
    """
    import asyncio

    from controller.gateway.gateway_settings import GatewaySettings, read_token, require_gateway

    require_gateway()
    from controller.api.link import find_socket
    from controller.gateway.app import serve

    host, port = _host_and_port(listen)
    token = {} if token_file is None else {"token": read_token(token_file)}
    settings = GatewaySettings(
        socket=find_socket(socket),
        host=host,
        port=port,
        extra_hosts=tuple(allow_host or ()),
        origins=tuple(allow_origin or ()),
        is_token_user_supplied=token_file is not None,
        **token,
    )

    def announce(port: int) -> None:
        fragment = f"#token={settings.token}"
        if token_file is not None:
            fragment = f" (token in {token_file})"
        print(f"dashboard: http://{settings.shown_host}:{port}/{fragment}", flush=True)

    asyncio.run(serve(settings, announce=announce))
    os._exit(0)  # Python would abort in the thread that draws the field


def _host_and_port(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, [HOST]:PORT or PORT alone."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdecimal()):
        raise InputError(f"--listen must be HOST:PORT, such as {DASHBOARD}, got {text}")
    return host.strip("[]") or "127.0.0.1", int(port)


EXIT_STATUS = {**by_hand.EXIT_STATUS, InputError: 2}

app = typer.Typer()
app.add_typer(layout_app, name="layout")
app.command(cls=DashboardCommand)(daemon)
app.command(cls=DashboardCommand)(demo)
for _command in (gateway, touch, watch):
    app.command()(_command)
for _name in ("disarm", "stop", "clear"):
    app.command(_name, help=SUMMARIES[_name])(of_method(_name))
for _method in (arm, reload, status, strength):
    app.command(
        help=f"{SUMMARIES[_method.__name__]} {_method.__doc__}",
        context_settings={"ignore_unknown_options": _method is strength},  # -6 is a number
    )(_method)
