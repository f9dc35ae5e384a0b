"""`python -m controller.metrics --socket PATH --port N`: serve a daemon's metrics on 127.0.0.1."""

import asyncio
import signal
from pathlib import Path
from typing import Annotated

import typer
from prometheus_client import CONTENT_TYPE_LATEST

from controller.api.async_client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.socket_path import find_socket
from controller.metrics.collector import exposition
from controller.metrics.server import PageServer
from drivers.errors import LinkError


def serve(
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1.", min=0, max=65535)],
    socket: Annotated[Path | None, typer.Option(help="The daemon's socket.")] = None,
) -> None:
    """Serve a daemon's metrics to Prometheus on 127.0.0.1, until SIGINT or SIGTERM."""
    try:
        asyncio.run(_serve(port, socket))
    except OSError as error:
        typer.echo(
            f"era: error: cannot serve metrics on 127.0.0.1 port {port} ({error.strerror}); stop "
            "the other program or give another port as `metrics` in the daemon's file",
            err=True,
        )
        raise typer.Exit(2) from error


async def _serve(port: int, socket: Path | None) -> None:
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)

    async def page() -> bytes:
        try:
            async with await AsyncClient.connect(find_socket(socket), name="metrics") as era:
                return exposition(await era.status())
        except (LinkError, RpcError):
            return exposition(None)

    server = await PageServer("/metrics", page, content=CONTENT_TYPE_LATEST).start(port)
    typer.echo(f"metrics: http://127.0.0.1:{server.sockets[0].getsockname()[1]}/metrics")
    await ended.wait()
    server.close()


if __name__ == "__main__":
    typer.run(serve)
