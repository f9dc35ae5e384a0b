"""The far end of the latency benchmark: a simulated amplifier on a pseudo-terminal, and a clock.

    python -m benchmarks.latency_far_end RIG FILE

Prints the URL. On SIGUSR1 it writes when each frame that asks for a set had arrived whole, on
CLOCK_MONOTONIC, its number and what it carries, a JSON line each, and prints that it has. The plate
takes no part.
"""

import asyncio
import gc
import json
import signal
import sys
import time
from pathlib import Path

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.serial_codec import decode_request, encode_reply
from drivers.protocol.serial_frame import Frame, FrameReader, encode_frame
from model.rig_file import load_rig
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.transport.pseudo_terminal import make_terminal


async def main() -> None:
    rig = load_rig(Path(sys.argv[1]))
    (name,) = rig.amplifiers
    amplifier = SimulatedAmplifier(name, channels=4)
    reader = FrameReader()
    seen: list[tuple[int, Frame]] = []

    def arrived(data: bytes) -> None:
        now = time.monotonic_ns()
        for frame in reader.feed(data):
            if frame.kind == PROTOCOL.types["apply"]:
                seen.append((now, frame))
            amplifier.tick(now * 1e-9)
            reply = amplifier.handle(decode_request(frame), now * 1e-9)
            terminal.write(encode_frame(encode_reply(reply, frame)))

    terminal = make_terminal(arrived)
    terminal.listen()

    def write() -> None:
        with Path(sys.argv[2]).open("w", encoding="utf-8") as stream:
            for when, frame in seen:
                line = json.dumps([when, frame.sequence, frame.payload.hex()])
                stream.write(f"{line}\n")
        print("written", flush=True)

    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, write)
    gc.collect()
    gc.freeze()
    gc.disable()  # it holds on to everything that it sees, so there is nothing to be collected
    print(f"serial://{terminal.port}?baud={PROTOCOL.serial.baud}", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
