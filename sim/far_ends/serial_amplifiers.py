"""The amplifiers' side of a serial line, without I/O: bytes in, bytes out.

On a shared line amplifiers have one address each, and send no events.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress

from drivers.protocol.definition import (
    BROADCAST,
    BY_NUMBER,
    EVENT,
    EVENT_RECORD,
    HELLO,
    MESSAGES,
    NAK,
    VERSION,
    nak_of,
)
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import is_earlier_part
from drivers.wires.serial_frames import (
    NEUTRAL,
    REPLY_BIT,
    Frame,
    FrameReader,
    encode_frame,
    pack_words,
    payload_of,
    unpack_words,
    words_of,
)
from sim.transport.far_end import AmplifierPort, FarEnd, Send, carry_out

_SET_ADDRESS = MESSAGES["SetAddress"].number


class SerialAmplifiers(FarEnd):
    """Amplifiers by their addresses on one line; send: called with the bytes for the host."""

    def __init__(self, amplifiers: Mapping[int, AmplifierPort], send: Send) -> None:
        self._amplifiers = dict(amplifiers)
        self._send = send
        self._reader = FrameReader()
        self._events = 0
        self._heard = [*amplifiers.values()] if len(amplifiers) == 1 else []
        for amplifier in self._heard:
            amplifier.listeners.append(self._send_event)

    def close(self) -> None:
        """Send no more events."""
        for amplifier in self._heard:
            amplifier.listeners.remove(self._send_event)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        for frame in self._reader.feed(data):
            if frame.is_reply or frame.type == EVENT:  # an echo
                continue
            if frame.address == BROADCAST:
                self._broadcast(frame, now)
                continue
            amplifier = self._amplifiers.get(frame.address)
            if amplifier is not None and amplifier.is_answering:
                reply = self._answer(frame, amplifier, now)
                if reply is not None:
                    self._send(encode_frame(reply))

    def _answer(self, frame: Frame, amplifier: AmplifierPort, now: float) -> Frame | None:
        """Return the reply to a request, a Nak where it is refused; None where it has none."""
        version = NEUTRAL if frame.type == HELLO else VERSION
        try:
            kind, words = self._carry_out(frame, amplifier, now)
        except Refusal as refusal:
            whole = unpack_words(frame.payload[: len(frame.payload) & ~1])
            is_part = frame.version == VERSION and is_earlier_part(frame.type, whole)
            kind, words = NAK, [] if is_part else nak_of(refusal, frame.type)
            version = NEUTRAL if refusal.code == "UNSUPPORTED_VERSION" else VERSION
        kind |= REPLY_BIT
        reply = frame._replace(kind=kind, payload=payload_of(kind, words), version=version)
        return reply if words else None

    def _carry_out(
        self, frame: Frame, amplifier: AmplifierPort, now: float
    ) -> tuple[int, Sequence[int]]:
        """Carry out a request by an amplifier; returns type and words of its reply, if it has one.

        Raises Refusal for a frame of another version, or with half a word.
        """
        if frame.type != HELLO and frame.version != VERSION:
            raise Refusal(f"version must be {VERSION}, got {frame.version}", "UNSUPPORTED_VERSION")
        words = words_of(frame) if frame.type in BY_NUMBER else ()
        kind, reply = carry_out(amplifier, frame.type, words, now)
        if kind == _SET_ADDRESS:
            self._amplifiers = {
                words[0] if each is amplifier else address: each
                for address, each in self._amplifiers.items()
            }
        return kind, reply

    def _broadcast(self, frame: Frame, now: float) -> None:
        message = BY_NUMBER.get(frame.type)
        if message is None or not message.is_broadcast:
            return
        for amplifier in self._amplifiers.values():
            if amplifier.is_answering:
                with suppress(Refusal):
                    kind, _ = self._carry_out(frame, amplifier, now)
                    if kind != NAK:
                        amplifier.withdraw_status()

    def _send_event(self, event: Values, now: float) -> None:
        ((address, amplifier),) = self._amplifiers.items()
        if not amplifier.is_answering:
            return
        self._events = (self._events + 1) & 0xFFFF
        payload = pack_words(EVENT_RECORD.pack(event))
        self._send(encode_frame(Frame(EVENT, address, self._events, payload, VERSION)))
