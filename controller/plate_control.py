"""Client of the control socket of a simulated plate: JSON objects, one per line, in order."""

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any

from drivers.errors import LinkError

_MAX_LINE = 1 << 20  # bytes of a reply; the signals of ten fingers take a fiftieth of it
_REPLY_TIMEOUT = 30.0  # s; long enough for a busy machine


class PlateControl:
    """A connection to a simulated plate, opened by the first request.

    A plate within this process exists only once its amplifier is open. remedy: added to the error
    if it does not reply.
    """

    def __init__(self, path: Path, *, remedy: str) -> None:
        self._path = path
        self._remedy = remedy
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._lock = asyncio.Lock()

    async def close(self) -> None:
        """Close the connection; a further request reopens it."""
        streams, self._streams = self._streams, None
        if streams is not None:
            streams[1].close()
            with contextlib.suppress(OSError):
                await streams[1].wait_closed()

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the reply to a request; raises LinkError if there is none or it is an error."""
        async with self._lock:
            try:
                reply = await self._reply_to(json.dumps(request).encode() + b"\n")
            except BaseException:
                await self.close()  # a late reply must not be taken for the next one
                raise
        if "error" in reply:
            raise LinkError(f"simulated plate: {request['op']} refused: {reply['error']}")
        return reply

    async def _reply_to(self, request: bytes) -> dict[str, Any]:
        if self._streams is None:
            self._streams = await self._connect()
        reader, writer = self._streams
        try:
            async with asyncio.timeout(_REPLY_TIMEOUT):
                writer.write(request)
                await writer.drain()
                line = await reader.readuntil()
        except TimeoutError:
            raise LinkError(
                f"simulated plate at {self._path}: no reply within {_REPLY_TIMEOUT:g} s; "
                f"{self._remedy}"
            ) from None
        except asyncio.LimitOverrunError:
            line = await reader.read(_MAX_LINE)
        except (OSError, EOFError) as error:
            raise LinkError(
                f"simulated plate at {self._path}: closed the connection, its process has ended; "
                f"{self._remedy}"
            ) from error
        reply = _object(line)
        if reply is None:
            start = line[:40].decode(errors="replace")
            raise LinkError(
                f"{self._path}: must be the control socket of a simulated plate, got the reply "
                f"{start!r}...; give the path of `era sim --control`"
            )
        return reply

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        try:
            return await asyncio.open_unix_connection(str(self._path), limit=_MAX_LINE)
        except OSError as error:
            raise LinkError(
                f"simulated plate at {self._path}: cannot connect ({error.strerror or error}); "
                f"{self._remedy}"
            ) from error


def _object(line: bytes) -> dict[str, Any] | None:
    """Decode a reply; None if it is not one of a plate."""
    try:
        reply = json.loads(line)
    except ValueError:
        return None
    is_object = isinstance(reply, dict) and isinstance(reply.get("error", ""), str)
    return reply if is_object else None
