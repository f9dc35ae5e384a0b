"""Damage to the bytes of frames."""

import random


def damage(data: bytes, chance: random.Random) -> bytes:
    """One to four bytes changed, inserted, removed, or a piece repeated; never empty."""
    damaged = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(damaged))
        match chance.randrange(5):
            case 0:
                damaged[at] ^= 1 << chance.randrange(8)
            case 1:
                damaged[at] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
            case 2:
                damaged.insert(at, chance.randrange(256))
            case 3 if len(damaged) > 8:
                del damaged[at : at + chance.randint(1, 4)]
            case _:
                damaged[at:at] = damaged[at : at + 10]
    return bytes(damaged).ljust(5, b"\0")
