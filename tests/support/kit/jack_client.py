"""Clients of a real JACK server, through jack-client: independent of PortAudio and the product."""

import time
from typing import TYPE_CHECKING

from drivers.errors import LinkError

if TYPE_CHECKING:
    import jack

_START = 60.0  # s; on a busy machine
_POLL = 0.02  # s


def jack_client(name: str, server: str | None = None) -> "jack.Client":
    """Open a client of that very name, as soon as the server is up; raises LinkError.

    server: its name; None for that in JACK_DEFAULT_SERVER.
    """
    import jack  # needs libjack, which a machine may lack

    jack.set_error_function(lambda _text: None)
    jack.set_info_function(lambda _text: None)
    deadline = time.monotonic() + _START
    while True:
        try:
            client = jack.Client(name, no_start_server=True, servername=server)
        except jack.JackOpenError as problem:
            if time.monotonic() > deadline:
                raise LinkError(f"jack: client {name} cannot be opened: {problem}") from None
            time.sleep(_POLL)
            continue
        if client.name == name:
            return client
        # The server has added a number. Asked for the exact name, it does not say what was wrong.
        client.close()
        raise LinkError(f"jack: client {name} cannot be opened: there is another of that name")
