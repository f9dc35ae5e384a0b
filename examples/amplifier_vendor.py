# %% [markdown]
"""
# An amplifier's side of the wire, byte by byte

For vendors of amplifiers. Run `python examples/amplifier_vendor.py`, or open it as a notebook in VS
Code or, with jupytext, in Jupyter. The protocol is described in
docs/reference/wire-protocol.md. Here frames are made by hand and by the project's codec, a
simulated amplifier replies to them on a serial line, and the conformance checks are run on it.
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
from drivers.conformance import CHECKS, Result, raw_line, run_check
from drivers.protocol.messages import Hello, Ping
from drivers.registry import open_backend

# %% [markdown]
"""
## A frame by hand
type · version · address · sequence · payload · CRC-32, little-endian, encoded by COBS so that it
contains no zero, between two zeros. A Ping (type 12, version 2) of session 9 to address 1 with
sequence 7:
"""


# %%
def stuffed(data):
    """Encode by COBS: before each piece between zeros its length plus one."""
    return b"".join(bytes([len(piece) + 1]) + piece for piece in data.split(b"\0"))


body = struct.pack("<BBBHH", 12, 2, 1, 7, 9)
by_hand = b"\0" + stuffed(body + struct.pack("<I", zlib.crc32(body))) + b"\0"
request = encode_request(Ping(session=9), address=1, sequence=7)
by_codec = encode_frame(request)
print("by hand ", by_hand.hex(" ").upper())
print("by codec", by_codec.hex(" ").upper())

# %% [markdown]
"""
## A simulated amplifier
`era sim` runs a simulated amplifier on a pseudo-terminal. The reader takes bytes as they arrive and
counts what is not a frame.
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
    """Send a request and read its reply; return the bytes and the message."""
    line.write(encode_frame(frame))
    reader, raw = FrameReader(), b""
    while True:
        byte = line.read(1)
        if not byte:
            raise TimeoutError(f"no reply; got {raw.hex(' ')}")
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
## Conformance
The checks of `era amp conformance URL` that only read, over the same line. The others arm the
amplifier and drive its channels: `era amp conformance URL --write` takes all, in half a minute.
Insert your amplifier's URL here.
"""


# %%
async def conform(url):
    """Run the checks that only read and return their outcomes."""
    amplifier = Amplifier(open_backend(url))
    await amplifier.open()
    try:
        raw = raw_line(url)
        reading = [check for check in CHECKS if not check.drives]
        return [await run_check(check, amplifier, raw, url=url) for check in reading]
    finally:
        await amplifier.close()


outcomes = asyncio.run(conform(url))
for outcome in outcomes:
    print(outcome.result.value, outcome.check.requirement)
    if outcome.reason:
        print("       ", outcome.reason, outcome.place)

# %%
far_end.terminate()
far_end.communicate(timeout=10)
print(sum(outcome.result is Result.FAILED for outcome in outcomes), "of", len(outcomes), "failed")
