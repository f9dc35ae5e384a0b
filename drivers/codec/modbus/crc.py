"""The checksum of Modbus RTU."""


def crc16(data: bytes) -> bytes:
    """CRC-16 of Modbus (polynomial 8005 reflected, initial FFFF), low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")
