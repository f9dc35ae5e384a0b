"""The control socket of a simulated plate, for whoever asks: JSON objects, one a line, in order."""

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any

from drivers.errors import LinkError

_LINE_MAX = 1 << 20  # bytes of an answer; what ten fingers felt takes a fiftieth of it
_PATIENCE = 30.0  # s; a far end on a busy machine


class PlateControl:
    """A simulated plate by its control socket; connects when it is first asked something.

    For a plate within this process is there only once its amplifier is open. remedy: what to do
    where it does not answer, for whoever reads the error.
    """

    def __init__(self, path: Path, *, remedy: str) -> None:
        self._path = path
        self._remedy = remedy
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._turn = asyncio.Lock()

    async def close(self) -> None:
        """Hang up; a further question connects again."""
        streams, self._streams = self._streams, None
        if streams is not None:
            streams[1].close()
            with contextlib.suppress(OSError):
                await streams[1].wait_closed()

    async def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """The answer to one line of control; LinkError where there is none, or an error in it."""
        async with self._turn:
            try:
                answer = await self._answer_to(json.dumps(question).encode() + b"\n")
            except BaseException:
                await self.close()  # the answer would be taken for that of the next question
                raise
        if "error" in answer:
            raise LinkError(f"the simulated plate refused {question['op']}: {answer['error']}")
        return answer

    async def _answer_to(self, question: bytes) -> dict[str, Any]:
        if self._streams is None:
            self._streams = await self._connect()
        reader, writer = self._streams
        try:
            async with asyncio.timeout(_PATIENCE):
                writer.write(question)
                await writer.drain()
                line = await reader.readuntil()
        except TimeoutError:
            raise LinkError(
                f"the simulated plate at {self._path} does not answer within {_PATIENCE:g} s; "
                f"{self._remedy}"
            ) from None
        except asyncio.LimitOverrunError:
            line = await reader.read(_LINE_MAX)
        except (OSError, EOFError) as error:
            raise LinkError(
                f"the simulated plate at {self._path} has hung up, so its process has ended; "
                f"{self._remedy}"
            ) from error
        answer = _object(line)
        if answer is None:
            said = line[:40].decode(errors="replace")
            raise LinkError(
                f"what listens at {self._path} is no simulated plate: it answers {said!r}...; give "
                "the path that `era sim` was given with --control"
            )
        return answer

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        try:
            return await asyncio.open_unix_connection(str(self._path), limit=_LINE_MAX)
        except OSError as error:
            raise LinkError(
                f"no simulated plate listens at {self._path} ({error.strerror or error}); "
                f"{self._remedy}"
            ) from error


def _object(line: bytes) -> dict[str, Any] | None:
    """The object in a line of a plate; None where no plate says such a thing."""
    try:
        answer = json.loads(line)
    except ValueError:
        return None
    is_object = isinstance(answer, dict) and isinstance(answer.get("error", ""), str)
    return answer if is_object else None
