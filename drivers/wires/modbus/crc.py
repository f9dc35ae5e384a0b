"""The checksum of Modbus RTU: CRC-16 (polynomial 8005 reflected, initial FFFF), low byte first."""


def _shifted(crc: int) -> int:
    """Shift eight bits out of a CRC."""
    for _ in range(8):
        crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


_TABLE = tuple(map(_shifted, range(256)))


def crc16(data: bytes) -> bytes:
    """Return the checksum of data."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")
