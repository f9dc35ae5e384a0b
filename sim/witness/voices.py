"""How many voices a channel may sound at most, from the sets that were sent and granted."""

import math

from sim.witness.decoded import Request, RequestKind

_MAX_ENVELOPE = 3.3  # s; 32 knots, 0.1 s apart
_LAG = 0.002  # s; of playback behind a commit


class Voices:
    """Upper bounds for one amplifier; stated: voices of a channel, 0 while not known."""

    def __init__(self) -> None:
        self.stated = 0
        self._fades: dict[int, float] = {}  # along which a set ends others, by token [s]
        self._ends: dict[int, float] = {}  # of its own voices, by token [s]
        self._max_envelope = 0.0  # of the envelopes in use [s]

    def sent(self, request: Request) -> None:
        """Note a set that may play from now on, or is staged."""
        token = request.token
        if request.kind is not RequestKind.STAGE:
            self._ends[token] = math.inf
        if request.kind is not RequestKind.COMMIT:
            self._fades[token] = request.ramp
        if any(command.onset or command.ending for command in request.commands.values()):
            self._max_envelope = _MAX_ENVELOPE

    def refused(self, token: int) -> None:
        """Note that a set does not play."""
        self._ends.pop(token, None)

    def granted(self, request: Request, time: float) -> None:
        """Note that a set plays by a time [s], and ends all others along its ramp."""
        if request.kind is RequestKind.STAGE:
            return
        playing = request.token
        faded = time + _LAG + max(self._fades.get(playing, math.inf), self._max_envelope)
        self._ends = {
            token: end if token == playing else min(end, faded)
            for token, end in self._ends.items()
            if end > time
        }
        self._fades = {playing: self._fades.get(playing, math.inf)}

    def at(self, time: float) -> int:
        """The most that may sound at a time [s]."""
        return sum(end > time for end in self._ends.values())
