"""TCP servers on the loopback interface."""

import asyncio
from collections.abc import Callable

from drivers.errors import LinkError

HOST = "127.0.0.1"


async def listen(make_client: Callable[[], asyncio.Protocol], port: int) -> asyncio.Server:
    """Listen on a port, 0 for any; raises LinkError where it is in use."""
    try:
        return await asyncio.get_running_loop().create_server(make_client, HOST, port)
    except OSError as error:
        raise LinkError(
            f"port {port}: cannot listen: {error.strerror or error}; choose another, or 0 for any"
        ) from error


def port_of(server: asyncio.Server) -> int:
    """The port on which a server listens."""
    return int(server.sockets[0].getsockname()[1])
