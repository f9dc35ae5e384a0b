"""Compute the plate's vibration for drawing, from the daemon's reports."""

import asyncio
import json
import logging
import math
from collections import defaultdict
from collections.abc import AsyncIterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from controller.api.jsonrpc import request_line
from controller.api.link import DaemonLink, Notification, read_line, result_of
from controller.api.schema import PlayedTone
from model.arrays import ComplexArray, lattice
from model.finger import detection_threshold
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import parse_rig
from registry.threads import in_thread

_COLUMNS = 64  # grid points along the longer side; several per bending wavelength
_MAX_FREQUENCIES = 64  # in the cache
_FULL_SCALE = 32767
_NO_FIELD = bytes(8 + 4)  # no columns, no rows, no fields, scale 0
_RETRY_INTERVAL = 0.5  # s; of connecting to the daemon
_TOPICS = b'{"topics":["pattern","silence"]}'
_LAYERS = TypeAdapter(dict[int, dict[str, PlayedTone]])

_NOT_CONNECTED = "not connected to a daemon"
_NOT_DRAWN = "field of the plate: not drawn"

_logger = logging.getLogger(__name__)


class FieldSolver:
    """Computes the vibration of a rig's plate; solves the plate once, and once per frequency."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._free = solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)
        longer_side = max(rig.plate.length, rig.plate.width)
        self.columns = max(2, math.ceil(_COLUMNS * rig.plate.length / longer_side))
        self.rows = max(2, math.ceil(_COLUMNS * rig.plate.width / longer_side))
        self._points = lattice(
            np.linspace(0, rig.plate.length, self.columns),
            np.linspace(0, rig.plate.width, self.rows),
        )
        self._response = lru_cache(_MAX_FREQUENCIES)(self._solve)

    def frame(self, layers: Mapping[int, Mapping[str, PlayedTone]]) -> bytes:
        """The complex acceleration of each layer under its drive by ERA, as a frame.

        A field is the vibration of a layer at a frequency. Little-endian: u16 columns, u16
        rows, u16 fields, u16 zero; f32 scale [m/s²]; per field f32 frequency [Hz]; per field f32
        detection threshold [m/s²]; per field u16 layer; then, per field, row from the south and
        column from the west, real and imaginary part as i16, where 32767 is the scale. Raises
        InputError.
        """
        names = [era.name for era in self._rig.eras]
        fields: defaultdict[tuple[int, float], ComplexArray] = defaultdict(
            lambda: np.zeros(self.rows * self.columns, complex)
        )
        for number, drive in sorted(layers.items()):
            for name, tone in drive.items():
                weight = tone.level * np.exp(1j * math.radians(tone.phase_deg))
                response = self._response(tone.frequency_hz)[names.index(name)]
                fields[number, tone.frequency_hz] += weight * response
        parts = np.array([*fields.values()], complex).view(float)  # real, imaginary, real, ...
        scale = float(np.abs(parts).max(initial=0.0))
        numbers = [number for number, _ in fields]
        frequencies = np.array([frequency for _, frequency in fields])
        thresholds = detection_threshold(frequencies, self._rig.threshold)
        sizes = np.array([self.columns, self.rows, len(fields), 0], "<u2")
        figures = np.array([scale, *frequencies, *thresholds], "<f4")
        vibration = np.rint(parts / (scale or 1.0) * _FULL_SCALE).astype("<i2")
        blocks = [sizes, figures, np.array(numbers).astype("<u2"), vibration]
        return b"".join([block.tobytes() for block in blocks])

    def _solve(self, frequency: float) -> ComplexArray:
        """Acceleration [m/s²] (eras, points) per ERA at full stroke."""
        response: ComplexArray = self._free.acceleration(
            self._rig.eras, np.array([frequency]), self._points, loads=self._rig.masses
        )[0]
        return response


class DrawnField:
    """The vibration of the plate as it plays, drawn once for all browsers; see `run`.

    Nothing that fails here ends anything but the picture.
    """

    def __init__(self, daemon: Path) -> None:
        self._daemon = daemon
        self._frame = _NO_FIELD
        self._changed = asyncio.Event()
        self._due = asyncio.Event()
        self._plays: tuple[str, Mapping[str, Any]] | None = None  # a rig file, and drives by layer
        self._solver = lru_cache(1)(lambda text: FieldSolver(parse_rig("the daemon's rig", text)))
        self._problems: dict[str, str] = {}  # logged reasons, by failure; removed when it ends

    async def frames(self) -> AsyncIterator[bytes]:
        """Yield the current frame, and then the newest whenever it changes."""
        while True:
            changed = self._changed
            yield self._frame
            await changed.wait()

    async def run(self) -> None:
        """Follow the daemon at the socket, and connect again after a loss, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._draw())
            while True:
                try:
                    await self._follow()
                except Exception as error:
                    self._note(_NOT_CONNECTED, error)
                self._show(None)
                await asyncio.sleep(_RETRY_INTERVAL)

    async def _follow(self) -> None:
        """Draw the playback until the daemon disconnects; raises RpcError and Unreachable."""
        link = await DaemonLink.open(self._daemon, "gateway")
        try:
            rig_text = json.loads(link.hello)["result"]["rig_text"]
            await link.send(request_line("gateway", "subscribe", _TOPICS))
            while True:
                received = read_line(await link.next_line())
                if isinstance(received, Notification):
                    self._show((rig_text, received.data.get("layers", {})))
                else:
                    result_of(received)  # raises if the daemon has too many clients
                    self._problems.pop(_NOT_CONNECTED, None)
        finally:
            link.abort()

    def _show(self, plays: tuple[str, Mapping[str, Any]] | None) -> None:
        self._plays = plays
        self._due.set()

    async def _draw(self) -> None:
        """Draw the playback after each change, in a thread because the first time takes a while."""
        while True:
            await self._due.wait()
            self._due.clear()
            frame = _NO_FIELD
            try:
                if self._plays is not None:
                    frame = await in_thread(partial(self._drawn, *self._plays), name="field")
                    self._problems.pop(_NOT_DRAWN, None)
            except Exception as error:
                self._note(_NOT_DRAWN, error)
            self._frame = frame
            self._changed.set()
            self._changed = asyncio.Event()

    def _drawn(self, rig_text: str, layers: Mapping[str, Any]) -> bytes:
        """Return the playback as a frame, ignoring additions of a later daemon."""
        return self._solver(rig_text).frame(_LAYERS.validate_python(layers, extra="ignore"))

    def _note(self, failure: str, error: Exception) -> None:
        """Log a failure with its reason, unless the same reason was logged and has not ended."""
        reason, _, _ = str(error).partition("\n")
        reason = reason or type(error).__name__
        if self._problems.get(failure) != reason:
            self._problems[failure] = reason
            _logger.warning("%s: %s", failure, reason)
