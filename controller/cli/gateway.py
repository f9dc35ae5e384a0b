"""`era gateway`: the daemon's API and the dashboard for browsers."""

import os
from pathlib import Path
from typing import Annotated

import typer

from model.errors import InputError


def gateway(
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on; port 0: any free one.")
    ] = "127.0.0.1:8137",
    socket: Annotated[
        Path | None, typer.Option(help="The daemon's socket (default: the usual one).")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(help="File (mode 600) with the token (default: a random one)."),
    ] = None,
    certificate: Annotated[Path | None, typer.Option(help="TLS certificate chain, PEM.")] = None,
    key: Annotated[Path | None, typer.Option(help="TLS key of the certificate, PEM.")] = None,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Further allowed host name."),
    ] = None,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(metavar="ORIGIN", help="Further allowed origin: https://HOST[:PORT]"),
    ] = None,
) -> None:
    """Serve the daemon's API and the dashboard to browsers.

    Prints the URL to open, with the token. An operational interface, not an emergency stop.
    """
    import asyncio

    from controller.gateway.installed import require_gateway

    require_gateway()
    from controller.api.place import find_socket
    from controller.gateway.serving import serve
    from controller.gateway.settings import Settings, read_token

    host, port = _host_and_port(listen)
    chosen = {} if token_file is None else {"token": read_token(token_file)}
    settings = Settings(
        socket=find_socket(socket),
        host=host,
        port=port,
        certificate=certificate,
        key=key,
        extra_hosts=tuple(allow_host or ()),
        origins=tuple(allow_origin or ()),
        is_token_user_supplied=token_file is not None,
        **chosen,
    )

    def announce(port: int) -> None:
        scheme = "https" if settings.is_encrypted else "http"
        token = "" if settings.is_token_user_supplied else f"#token={settings.token}"
        print(f"dashboard: {scheme}://{settings.shown_host}:{port}/{token}", flush=True)

    asyncio.run(serve(settings, announce=announce))
    os._exit(0)  # Python would abort in the thread that draws the field


def _host_and_port(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, [HOST]:PORT or PORT alone."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdecimal()):
        raise InputError(f"--listen must be HOST:PORT, such as 127.0.0.1:8137, got {text}")
    return host.strip("[]") or "127.0.0.1", int(port)
