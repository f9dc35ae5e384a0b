"""Touch sources over UDP: host, port and timeout of their URL, the port, a frame per datagram."""

import asyncio
import math
import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import ClassVar

from controller.sources.contacts import CONTACT_TIMEOUT, MAX_CONTACT_TIMEOUT
from controller.sources.datagrams import MAX_DATAGRAM, Datagram, Peer, listen
from controller.sources.touch import TouchFrame, TouchSource, number_option
from model.errors import InputError
from registry import threads

DEFAULT_HOST = "127.0.0.1"
_PORT = re.compile(r"[0-9]{1,5}")


class UdpSource(TouchSource):
    """Listens at `SCHEME:HOST:PORT`, or `SCHEME:PORT` of 127.0.0.1, and reads each datagram.

    A panel on another machine needs an explicit HOST: datagrams have no authentication.
    `?timeout=SECONDS`: how long a resting finger stays without a frame. Raises InputError for any
    other URL, and in `run` if the port is taken.
    """

    default_port: ClassVar[str] = ""
    """Where the URL has none; empty: it must have one."""
    default_timeout: ClassVar[float] = CONTACT_TIMEOUT
    """Where the URL has none [s]."""
    max_size: ClassVar[int] = MAX_DATAGRAM
    """Bytes of the longest datagram; longer ones are cut to one byte more."""

    def __init__(self, url: str) -> None:
        self._url = url
        self.opened = math.inf
        """When the port was bound [s]."""
        address, _, options = url.partition("?")
        scheme, _, rest = address.partition(":")
        host, _, port = rest.removeprefix("//").rpartition(":")
        self.host = host.strip("[]") or DEFAULT_HOST
        port = port or self.default_port
        if not _PORT.fullmatch(port) or int(port) > 65535:
            raise InputError(
                f"touch source must be {scheme}:HOST:PORT with a port from 0 to 65535, such as "
                f"{scheme}:{DEFAULT_HOST}:{self.default_port or 3333}, got {url}"
            )
        self.port = int(port)
        self.timeout = number_option(options, "timeout", default=self.default_timeout)
        """Time [s] that `read` gives its frames."""
        if not CONTACT_TIMEOUT <= self.timeout <= MAX_CONTACT_TIMEOUT:  # NaN is not
            raise InputError(
                f"touch source {url}: options must be ?timeout=SECONDS from {CONTACT_TIMEOUT:g} to "
                f"{MAX_CONTACT_TIMEOUT:g}, got ?{options}"
            )

    @abstractmethod
    def read(self, datagram: bytes, peer: Peer, arrived: float) -> TouchFrame | None:
        """Return the frame that a datagram completes, or None.

        peer: host and port of the sender; arrived [s]: the time of the frame. Malformed input must
        be counted in `rejects`, not raised.
        """

    def drop_superseded(self, waiting: Sequence[Datagram]) -> Iterable[Datagram]:
        """Return those of many waiting datagrams, in order, that no later one supersedes."""
        return waiting

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver a frame per datagram until cancelled."""

        def received(datagram: bytes, peer: Peer, arrived: float) -> None:
            frame = self.read(datagram, peer, arrived)
            if frame is not None:
                deliver(frame)

        try:
            endpoint = await listen(
                self.host,
                self.port,
                received,
                max_size=self.max_size,
                drop_superseded=self.drop_superseded,
            )
        except OSError as error:
            raise InputError(
                f"touch source {self._url}: cannot bind UDP {self.host}:{self.port} "
                f"({error.strerror}); stop the program that uses it, or choose another port or "
                "address of this machine"
            ) from error
        self.opened = threads.now()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            endpoint.close()
