"""`python -m controller.metrics --socket PATH --port N`: serve a daemon's metrics on 127.0.0.1."""

import signal
from pathlib import Path
from typing import Annotated

import typer
from prometheus_client import CollectorRegistry, start_http_server

from controller.api.client import Client
from controller.api.methods import StatusResult
from controller.api.socket_path import find_socket
from controller.metrics.collector import DaemonCollector


def serve(
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1.", min=0, max=65535)],
    socket: Annotated[Path | None, typer.Option(help="The daemon's socket.")] = None,
) -> None:
    """Serve a daemon's metrics to Prometheus on 127.0.0.1, until SIGINT or SIGTERM."""

    def read_status() -> StatusResult:
        with Client.connect(find_socket(socket), name="metrics") as era:
            return era.status()

    registry = CollectorRegistry(auto_describe=False)
    registry.register(DaemonCollector(read_status))
    try:
        server, _ = start_http_server(port, addr="127.0.0.1", registry=registry)
    except OSError as error:
        typer.echo(
            f"era: error: cannot serve metrics on 127.0.0.1 port {port} ({error.strerror}); stop "
            "the other program or give another port as `metrics` in the daemon's file",
            err=True,
        )
        raise typer.Exit(2) from error
    typer.echo(f"metrics: http://127.0.0.1:{server.server_port}/metrics")
    signal.sigwait({signal.SIGTERM, signal.SIGINT})


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
    typer.run(serve)
