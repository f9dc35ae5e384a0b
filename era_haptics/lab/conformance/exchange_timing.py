"""Durations of exchanges with the amplifier under test, and the lateness of its replies.

A reply can be late because of the amplifier, the line or this machine. The shortest exchange of a
message shows how much time the amplifier and the line need. A reaction time is an exchange without
the time on the wire.
"""

import math

from drivers.protocol.definition import REACTION
from era_haptics.lab.conformance.judge_client import QUIET_TIME, JudgeClient, RequestOutcome

SLOWEST = 0.1
"""Longest exchange time [s] that makes other times longer."""

_READ_REQUESTS = ("GetCaps", "GetStatus", "GetFaults")  # on Modbus each takes half an exchange
_PROMPT = 0.02  # s, exchange time of a fast line


class ExchangeTiming:
    """Shortest exchanges so far with the amplifier behind a client."""

    def __init__(self, client: JudgeClient) -> None:
        self._client = client
        self._fastest: dict[str, float] = {}
        """Shortest exchange [s] by message name; rejections do not count."""
        self._pace = 1.0
        """Upper bound of the share of `wire_time` that the line takes: a terminal has no bit
        times."""

    @property
    def exchange_time(self) -> float:
        """Shortest exchange [s] of the slowest message so far, or the allowed time if shorter.

        The bound keeps a slow amplifier from extending its own deadlines. An unknown delay of the
        line shows in a reading.
        """
        count = self._client.transactions
        read_time = self.read_time
        times = [time for name, time in self._fastest.items() if name not in _READ_REQUESTS]
        slowest = max(times, default=read_time)
        allowed = count * REACTION + max(self._client.transit, count * read_time)
        return min(slowest, allowed)

    @property
    def read_time(self) -> float:
        """The shortest exchange [s] so far of a message that only reads."""
        times = [time for name, time in self._fastest.items() if name in _READ_REQUESTS]
        return min(times, default=math.inf)

    @property
    def slowness(self) -> float:
        """Factor for times, compared with a line with exchanges of 20 ms or less."""
        return max(min(self.exchange_time, SLOWEST) / _PROMPT, 1.0)

    def note(
        self, name: str, reply: RequestOutcome, duration: float, words: int, parts_time: float
    ) -> None:
        """Record an exchange that took a time [s], and how late its reply was.

        words: of the request; parts_time [s]: on the wire, for parts sent before.
        """
        client = self._client
        client.quiet = min(client.quiet, QUIET_TIME + duration)
        wire_time = client.wire_time(words, len(reply.words))
        if not reply.code:  # a rejection can arrive earlier
            self._pace = min(self._pace, duration / wire_time if wire_time else 0.0)
            self._fastest[name] = min(self._fastest.get(name, math.inf), duration)
        beyond = max(duration - self._pace * (parts_time + wire_time), 0.0)
        count = 1 if name in _READ_REQUESTS else client.transactions
        lateness = client.lateness
        reactions = lateness.reactions["refusals" if reply.code else name]
        reactions.append(beyond / count)
        lateness.note_delay(beyond - count * min(reactions))
