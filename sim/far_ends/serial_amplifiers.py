"""The amplifiers' side of a serial line, without I/O: bytes in, bytes out.

On a shared line each amplifier has an address of its own, and sends no events.
"""

from collections.abc import Mapping, Sequence

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
from drivers.urls import BAUD
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
from sim.transport.far_end import AmplifierPort, FarEnd, SendBytes, carry_out
from sim.transport.serving import FarEndKind

_SET_ADDRESS = MESSAGES["SetAddress"].number


class SerialAmplifiers(FarEnd):
    """Amplifiers by address on one line; send: called with the bytes for the host."""

    def __init__(self, amplifiers: Mapping[int, AmplifierPort], send: SendBytes) -> None:
        self._amplifiers = dict(amplifiers)
        self._send = send
        self._reader = FrameReader()
        self._event_count = 0
        self._is_shared = len(amplifiers) != 1
        if not self._is_shared:
            for amplifier in amplifiers.values():
                amplifier.listeners.append(self._send_event)

    def close(self) -> None:
        """Send no more events."""
        if not self._is_shared:
            for amplifier in self._amplifiers.values():
                amplifier.listeners.remove(self._send_event)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        for frame in self._reader.feed(data):
            if frame.is_reply or frame.type == EVENT:  # an echo
                continue
            for address, amplifier in [*self._amplifiers.items()]:
                if frame.address in (BROADCAST, address) and amplifier.is_answering:
                    self._take(frame, amplifier, now)

    def _take(self, frame: Frame, amplifier: AmplifierPort, now: float) -> None:
        """Let an amplifier carry out a request, and send the reply if there is one.

        A request of another version, or with half a word, is rejected.
        """
        version = NEUTRAL if frame.type == HELLO else VERSION
        is_for_all = frame.address == BROADCAST
        try:
            if frame.version != version == VERSION:
                raise Refusal(
                    f"version must be {VERSION}, got {frame.version}", "UNSUPPORTED_VERSION"
                )
            words = words_of(frame) if frame.type in BY_NUMBER else ()
            kind, reply = carry_out(amplifier, frame.type, words, now, is_for_all=is_for_all)
        except Refusal as refusal:
            kind = NAK
            reply = _nak_words(frame, refusal)
            version = NEUTRAL if refusal.code == "UNSUPPORTED_VERSION" else VERSION
        if kind == _SET_ADDRESS:
            self._move(amplifier, words[0])
        if reply and not is_for_all:
            kind |= REPLY_BIT
            payload = payload_of(kind, reply)
            self._send(encode_frame(frame._replace(kind=kind, payload=payload, version=version)))

    def _move(self, amplifier: AmplifierPort, new_address: int) -> None:
        """Give an amplifier another address; the order of the amplifiers stays."""
        moved: dict[int, AmplifierPort] = {}
        for address, present in self._amplifiers.items():
            moved[new_address if present is amplifier else address] = present
        self._amplifiers = moved

    def _send_event(self, event: Values, now: float) -> None:
        ((address, amplifier),) = self._amplifiers.items()
        if not amplifier.is_answering:
            return
        self._event_count = (self._event_count + 1) & 0xFFFF
        payload = pack_words(EVENT_RECORD.pack(event))
        self._send(encode_frame(Frame(EVENT, address, self._event_count, payload, VERSION)))


def _nak_words(frame: Frame, refusal: Refusal) -> Sequence[int]:
    """The words of a Nak to a request; none to a part of a set other than the last."""
    whole_words = unpack_words(frame.payload[: len(frame.payload) & ~1])
    if frame.version == VERSION and is_earlier_part(frame.type, whole_words):
        return ()
    return nak_of(refusal, frame.type)


SERIAL_KIND = FarEndKind(
    "serial",
    "serial://{port}?baud={speed}&address={address}",
    "a pseudo-terminal; `--shared` puts all amplifiers on one, at addresses 1, 2, ...",
    BAUD,
    "usb-high-speed",
    SerialAmplifiers,
    bits=10,
)
