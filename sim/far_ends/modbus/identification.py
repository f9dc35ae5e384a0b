"""Device identification over Modbus (function 43/14)."""

from collections.abc import Mapping

from drivers.protocol.messages import Identity
from sim.far_ends.modbus.pdu import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusException
from sim.far_ends.modbus.registers import MAP, text_bytes

IDENTIFY = 43
_READ = 0x0E  # MEI type
_BASIC, _ONE = (1, 2), 4  # codes: 1 and 2 without the vendor's own objects, 3 with them, 4 one
_NUMBERS: Mapping[str, int] = MAP["device_identification"]
_EXTENDED = 0x80  # objects from here on are the vendor's own
_CONFORMITY = 0x83  # extended identification, as a stream and one by one


def identification(body: bytes, identity: Identity) -> bytes:
    """The reply PDU to the bytes after the function; raises ModbusException."""
    if len(body) != 3 or not 1 <= body[1] <= _ONE:
        raise ModbusException(ILLEGAL_VALUE)
    _, code, first = body
    texts = {
        number: text_bytes(getattr(identity, name))
        for name, number in _NUMBERS.items()
        if code not in _BASIC or number < _EXTENDED
    }
    if code == _ONE:
        if first not in texts:
            raise ModbusException(ILLEGAL_ADDRESS)
        texts = {first: texts[first]}
    elif first in texts:
        texts = {number: text for number, text in texts.items() if number >= first}
    listed = b"".join(bytes([number, len(text)]) + text for number, text in texts.items())
    return bytes([IDENTIFY, _READ, code, _CONFORMITY, 0, 0, len(texts)]) + listed
