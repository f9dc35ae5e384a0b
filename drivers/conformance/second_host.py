"""A second host, to be killed: it arms an amplifier, plays, and feeds the watchdog.

    python -m drivers.conformance.second_host URL WATCHDOG

It prints a line once it plays.
"""

import asyncio
import sys

from drivers.amplifier import Amplifier
from drivers.conformance.bench import Bench
from drivers.registry import open_backend

_LIFE = 5.0  # s; if it is not killed


async def play(url: str, watchdog: float) -> None:
    """Arm the amplifier at a URL with a watchdog [s], and play."""
    amplifier = Amplifier(open_backend(url))
    await amplifier.open()
    bench = Bench(amplifier)
    await bench.arm(watchdog)
    await bench.play(1.0)
    sys.stdout.write("armed\n")
    sys.stdout.flush()
    await bench.wait(_LIFE)


if __name__ == "__main__":
    asyncio.run(play(sys.argv[1], float(sys.argv[2])))
