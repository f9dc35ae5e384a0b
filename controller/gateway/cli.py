"""`era gateway`: the daemon's API and its page in browsers."""

import os
import threading
from pathlib import Path
from typing import Annotated

import typer

from model.errors import InputError

app = typer.Typer()

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2}


@app.callback()
def _only_commands() -> None:
    """Keep `gateway` a command, though it is the only one."""


@app.command()
def gateway(
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where browsers reach it; port 0: a free one.")
    ] = "127.0.0.1:8137",
    socket: Annotated[
        Path | None, typer.Option(help="The daemon's socket; its usual place if left out.")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(help="A file (mode 600) with the token; a new one is made if left out."),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(help="For TLS: the certificate chain, PEM.")
    ] = None,
    key: Annotated[Path | None, typer.Option(help="For TLS: the certificate's key, PEM.")] = None,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A further name by which browsers call it."),
    ] = None,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(metavar="ORIGIN", help="Pages of others that may use it: https://HOST[:PORT]"),
    ] = None,
) -> None:
    """Put the daemon's API and the dashboard before browsers.

    Prints the URL to open; it holds the token. An operational interface, no emergency stop.
    """
    import asyncio

    from controller.gateway.installed import require_gateway

    require_gateway()
    from controller.api.socket_path import find_socket
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
        names=tuple(allow_host or ()),
        origins=tuple(allow_origin or ()),
        chose_token=token_file is not None,
        **chosen,
    )

    def announce(port: int) -> None:
        scheme = "https" if settings.is_encrypted else "http"
        token = "" if settings.chose_token else f"#token={settings.token}"
        print(f"dashboard: {scheme}://{settings.shown_host}:{port}/{token}", flush=True)

    asyncio.run(serve(settings, announce=announce))
    if threading.active_count() > 1:
        # The plate's field is being solved: Python would abort within it. Nothing is left to do.
        os._exit(0)


def _host_and_port(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, [HOST]:PORT or PORT alone."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdecimal()):
        raise InputError(f"--listen {text}: expected HOST:PORT, such as 127.0.0.1:8137")
    return host.strip("[]") or "127.0.0.1", int(port)
