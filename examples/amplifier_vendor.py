# %% [markdown]
"""
# An amplifier's side of the wire, byte by byte

For who builds an amplifier. Run it: `python examples/amplifier_vendor.py`, or open it as a notebook
in VS Code or, with jupytext, in Jupyter. The protocol is told in
docs/reference/wire-protocol.md; here frames are made by hand and by the project's codec, a
simulated amplifier answers them on a serial line, and the contract that every amplifier must keep
is run against it.
"""

# %%
import asyncio
import atexit
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import serial

import era_haptics as era
from drivers.amplifier import Amplifier
from drivers.codec.serial_line.exchanges import decode_reply, encode_request
from drivers.codec.serial_line.frame import FrameReader, encode_frame
from drivers.conformance import CHECKS, run_check
from drivers.protocol.messages import Hello, Ping
from drivers.registry import open_backend

# %% [markdown]
"""
## A frame by hand
first · address · sequence · payload · CRC-32, all little-endian, stuffed by COBS so that no zero is
in it, between two zeros. A Ping (type 12, version 1, so first = 2C) to address 1 with sequence 7:
"""


# %%
def stuffed(data):
    """COBS: in front of each piece between zeros its length plus one."""
    return b"".join(bytes([len(piece) + 1]) + piece for piece in data.split(b"\0"))


body = struct.pack("<BBH", 0x2C, 1, 7)
by_hand = b"\0" + stuffed(body + struct.pack("<I", zlib.crc32(body))) + b"\0"
request = encode_request(Ping(), address=1, sequence=7)
by_codec = encode_frame(request)
print("by hand ", by_hand.hex(" ").upper())
print("by codec", by_codec.hex(" ").upper())

# %% [markdown]
"""
## A far end that answers
`era sim` puts a simulated amplifier on a pseudo-terminal. To it the frame above is one like any
other; the reader takes bytes as they come and says what it could not use.
"""

# %%
ERA = Path(sys.executable).with_name("era")
far_end = subprocess.Popen(
    [ERA, "sim", era.example_rig_path(), "--serial"], stdout=subprocess.PIPE, text=True
)
atexit.register(far_end.terminate)  # also where a cell fails
url = far_end.stdout.readline().strip().removeprefix("main: ")
path = url.removeprefix("serial://").partition("?")[0]


def exchange(line, frame):
    """Send the bytes of a request and read the bytes of its answer."""
    line.write(encode_frame(frame))
    reader, raw = FrameReader(), b""
    while True:
        byte = line.read(1)
        if not byte:
            raise TimeoutError(f"no answer; got {raw.hex(' ')}")
        raw += byte
        for answer in reader.feed(byte):
            return raw, decode_reply(answer, frame)


with serial.Serial(path, 921_600, timeout=5) as line:
    pong_bytes, pong = exchange(line, request)
    print("reply   ", pong_bytes.hex(" ").upper(), "->", type(pong).__name__, pong.state.name)
    _, identity = exchange(line, encode_request(Hello(), address=1, sequence=8))
    print("it is   ", identity.vendor, identity.product, identity.serial_number)

# %% [markdown]
"""
## The contract
The same checks as `era amp conformance URL --write`, over the same line. Those that drive its
channels arm the amplifier; each begins and ends disarmed. Put your amplifier's URL here.
"""


# %%
async def conform(url):
    """What came of every check."""
    amplifier = Amplifier(open_backend(url))
    await amplifier.open()
    try:
        return [await run_check(check, amplifier) for check in CHECKS]
    finally:
        await amplifier.close()


outcomes = asyncio.run(conform(url))
for outcome in outcomes:
    print("passed" if outcome.problem is None else "FAILED", outcome.check.proves)
    if outcome.problem:
        print("       ", outcome.problem)

# %%
far_end.terminate()
far_end.communicate(timeout=10)
print(sum(outcome.problem is None for outcome in outcomes), "of", len(outcomes), "passed")
