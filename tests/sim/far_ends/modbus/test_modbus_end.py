"""The amplifiers' side of Modbus: raw bytes, masters that are not ours, and what is damaged."""

import asyncio
import contextlib
import os
import re
import socket
import struct
import time
import tty
from collections.abc import AsyncIterator

import minimalmodbus
import pytest
from pymodbus.client import AsyncModbusTcpClient

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import AmplifierState, Commit, Fault, NakCode, Ping, Stop
from model.rig.file import example_rig_path
from model.rig.rig import Rig
from sim.far_ends.modbus.end import ModbusRtuEnd, ModbusTcpEnd
from sim.far_ends.modbus.frames import FRAME_TIMEOUT, TCP_TIMEOUT, RtuReader, TcpReader, crc
from sim.far_ends.wires import Wire
from vendor_pages import EXAMPLES, ScriptedDevice
from wires import FarSide, far_side

PAGE = (example_rig_path().parent.parent / "docs" / "reference" / "wire-modbus.md").read_text(
    "utf-8"
)
FRAMES = {
    name: bytes.fromhex(data)
    for name, data in re.findall(
        r"^([\w ]+ (?:request|reply), (?:RTU|TCP)): `([0-9A-F ]+)`$", PAGE, re.MULTILINE
    )
}
MAP = PROTOCOL.modbus
STATUS, TOKEN, LEVELS = 1001, 1004, 1011  # of the vendor page
TIMEOUT = 5.0  # s; for what is expected to come


class Master:
    """Raw bytes to a far end and back."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.received = bytearray()
        self._came = asyncio.Event()
        self._fd = -1
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> "Master":
        """Connect, or open the terminal."""
        if self.url.startswith("modbus+tcp"):
            host, _, port = self.url.removeprefix("modbus+tcp://").partition("/")[0].partition(":")
            reader, self._writer = await asyncio.open_connection(host, int(port))
            self._task = asyncio.create_task(self._read(reader))
        else:
            path = self.url.removeprefix("modbus+rtu://").partition("?")[0]
            self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(self._fd)
            asyncio.get_running_loop().add_reader(self._fd, self._readable)
        return self

    def send(self, data: bytes) -> None:
        """Put bytes on the wire."""
        if self._writer is not None:
            self._writer.write(data)
        else:
            os.write(self._fd, data)

    async def receive(self, count: int) -> bytes:
        """The next so many bytes."""
        async with asyncio.timeout(TIMEOUT):
            while len(self.received) < count:
                self._came.clear()
                await self._came.wait()
        data = bytes(self.received[:count])
        del self.received[:count]
        return data

    async def __aexit__(self, *_: object) -> None:
        if self._fd >= 0:
            asyncio.get_running_loop().remove_reader(self._fd)
            os.close(self._fd)
        if self._writer is not None and self._task is not None:
            self._writer.close()
            with contextlib.suppress(OSError):
                await self._writer.wait_closed()
            await self._task

    def _readable(self) -> None:
        self.received += os.read(self._fd, 4096)
        self._came.set()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(4096):
                self.received += data
                self._came.set()


@contextlib.asynccontextmanager
async def scripted(wire: str, *devices: ScriptedDevice) -> AsyncIterator[Master]:
    """A raw master at a far end with scripted amplifiers."""
    end = ModbusTcpEnd(devices) if wire == "TCP" else ModbusRtuEnd(devices)
    if isinstance(end, ModbusTcpEnd):
        await end.start()
    else:
        end.start()
    async with Master(next(iter(end.urls.values()))) as master:
        yield master
    if isinstance(end, ModbusTcpEnd):
        await end.close()
    else:
        end.close()


@pytest.fixture
async def tcp(coarse_rig: Rig) -> AsyncIterator[FarSide]:
    """The paper's amplifier behind a TCP port."""
    async with far_side(Wire("modbus-tcp"), coarse_rig) as far:
        yield far


@pytest.fixture
async def rtu(coarse_rig: Rig) -> AsyncIterator[FarSide]:
    """The paper's amplifier on a serial line."""
    async with far_side(Wire("modbus-rtu"), coarse_rig) as far:
        yield far


every_wire = pytest.mark.parametrize("wire", ["RTU", "TCP"])


@every_wire
def test_slow_bytes_make_one_request(wire: str) -> None:
    """Bytes just less than the pause that ends a frame apart are one, those further apart none."""
    arm = FRAMES[f"Arm request, {wire}"]
    longest = TCP_TIMEOUT if wire == "TCP" else FRAME_TIMEOUT
    for pause, expected in ((0.99 * longest, 1), (1.01 * longest, 0)):
        reader = TcpReader() if wire == "TCP" else RtuReader()
        found = [
            request
            for number, byte in enumerate(arm)
            for request in reader.feed(bytes([byte]), number * pause)
        ]
        assert len(found) == expected


@every_wire
async def test_requests_in_one_piece_are_answered_in_order(wire: str) -> None:
    """The second of two requests that came together has its own reply."""
    arm, ping = (FRAMES[f"{name} request, {wire}"] for name in ("Arm", "Ping"))
    expected = FRAMES[f"Arm reply, {wire}"]
    device = ScriptedDevice()
    async with scripted(wire, device) as master:
        device.follow(EXAMPLES["Arm"])
        master.send(ping + arm)
        replies = await master.receive(2 * len(expected))
        assert replies[len(expected) :] == expected
        assert master.received == b""


@pytest.mark.parametrize(
    ("wire", "damage"),
    [
        (wire, damage)
        for wire in ("RTU", "TCP")
        for damage in ("cut", "flipped", "garbage before", "length")
        if (wire, damage) != ("TCP", "flipped")  # found by TCP itself
    ],
)
async def test_modbus_recovers_after_a_damaged_frame(
    wire: str, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is damaged has no effect and gets no answer but, over TCP, an exception."""
    stop, ping = (FRAMES[f"{name} request, {wire}"] for name in ("Stop", "Ping"))
    damaged = {
        "cut": stop[:-4],
        "flipped": stop[:-3] + bytes([stop[-3] ^ 0x40]) + stop[-2:],
        "garbage before": b"\x17\x55\xaa\x00\xff\x31",
        "length": stop[:5] + bytes([0xFF]) + stop[6:],
    }[damage]
    monkeypatch.setattr(TcpReader, "timeout", FRAME_TIMEOUT)
    device = ScriptedDevice()
    async with scripted(wire, device) as master:
        master.send(damaged)
        await asyncio.sleep(FRAME_TIMEOUT + 0.02)
        device.follow(EXAMPLES["Ping"])
        master.received.clear()
        master.send(ping)
        reply = FRAMES[f"Ping reply, {wire}"]
        assert await master.receive(len(reply)) == reply
        assert not any(isinstance(request, Stop) for request in device.asked)


@every_wire
async def test_modbus_ignores_other_units(wire: str) -> None:
    """Another unit is silent: the first answer is that of the frame after it."""
    ping = FRAMES[f"Ping request, {wire}"]
    device = ScriptedDevice()
    async with scripted(wire, device) as master:
        other = bytearray(ping)
        other[0 if wire == "RTU" else 6] = 9
        if wire == "RTU":
            other[-2:] = struct.pack("<H", crc(bytes(other[:-2])))
        master.send(bytes(other))
        device.follow(EXAMPLES["Ping"])
        master.send(ping)
        reply = FRAMES[f"Ping reply, {wire}"]
        assert await master.receive(len(reply)) == reply
        assert device.asked.count(Ping(9)) == 1


async def test_modbus_tcp_unit_255_is_the_only_unit() -> None:
    """For masters without units; with several amplifiers it is no unit."""
    ping = bytearray(FRAMES["Ping request, TCP"])
    ping[6] = 255
    device = ScriptedDevice()
    device.follow(EXAMPLES["Ping"])
    async with scripted("TCP", device) as master:
        master.send(bytes(ping))
        reply = FRAMES["Ping reply, TCP"]
        assert (await master.receive(len(reply)))[7:] == reply[7:]
    pair = ScriptedDevice(), ScriptedDevice(address=2)
    async with scripted("TCP", *pair) as master:
        master.send(bytes(ping))
        pair[0].follow(EXAMPLES["Ping"])
        master.send(FRAMES["Ping request, TCP"])
        assert await master.receive(len(reply)) == reply
        assert pair[0].asked.count(Ping(9)) == 1


@every_wire
async def test_modbus_broadcast_reaches_every_unit_without_reply(wire: str) -> None:
    """Commit and stop to unit 0 are executed by all, a set is ignored."""
    pair = ScriptedDevice(), ScriptedDevice(address=2)
    async with scripted(wire, *pair) as master:
        apply = bytearray(FRAMES[f"FC16 Apply request, {wire}"])
        apply[0 if wire == "RTU" else 6] = 0
        if wire == "RTU":
            apply[-2:] = struct.pack("<H", crc(bytes(apply[:-2])))
        master.send(bytes(apply))
        for name in ("Broadcast Commit", "Broadcast Stop"):
            master.send(FRAMES[f"{name} request, {wire}"])
        master.send(FRAMES[f"Ping request, {wire}"])
        await master.receive(len(FRAMES[f"Ping reply, {wire}"]))
        assert master.received == b""
    for device in pair:
        assert device.heard == [Commit(513, 9), Stop(0.005)]


async def test_modbus_hung_amplifier_does_not_reply() -> None:
    """Neither to requests nor to broadcasts."""
    device = ScriptedDevice()
    device.is_answering = False
    async with scripted("TCP", device) as master:
        for name in ("Hello", "Arm", "Apply"):
            master.send(FRAMES[f"{name} request, TCP"])
        await asyncio.sleep(0.02)
        assert master.received == b""
    assert device.asked == []


_LOUD = "10 00 10 00 09 12 00 01 00 09 00 01 00 00 00 00 08 98"  # one channel, at 110 Hz
EXCEPTIONS = {
    "unknown function": ("07", "87 01"),
    "device identification": ("2B 0E 03 00", "AB 01"),
    "register that is not there": ("04 07 6E 00 01", "84 02"),
    "read beyond the end": ("04 03 E8 FF FF", "84 03"),
    "read of nothing": ("04 03 E8 00 00", "84 03"),
    "read of 126": ("03 03 E8 00 7E", "83 03"),
    "short read": ("04 03 E8", "84 03"),
    "write to a status": ("10 03 EA 00 01 02 00 04", "90 02"),
    "function 6": ("06 00 02 00 02", "86 01"),
    "ramp without a controlword": ("10 00 04 00 01 02 00 05", "90 02"),
    "unmapped register": ("10 00 00 00 02 04 00 01 00 02", "90 02"),
    "write amid a set": ("10 00 11 00 01 02 00 04", "90 02"),
    "write beyond a set": ("10 00 10 00 46 8C" + 70 * " 00 01", "90 02"),
    "byte count": ("10 00 02 00 03 05 00 0F 00 FA 00", "90 03"),
    "write of nothing": ("10 00 02 00 00 00", "90 03"),
    "read and write, short": ("17 03 E8 00", "97 03"),
    "controlword": ("10 00 02 00 01 02 00 07", "90 03"),
    "watchdog": ("10 00 02 00 04 08 00 0F 00 63 00 00 00 09", "90 03"),
    "session 0": ("10 00 02 00 04 08 00 0F 00 FA 00 00 00 00", "90 03"),
    "set without a session": ("10 00 10 00 01 02 00 05", "90 03"),
    "token 0": ("10 00 10 00 02 04 00 00 00 09", "90 03"),
    "two tokens": ("10 00 10 00 05 0A 00 02 00 09 00 01 00 00 00 00", "90 03"),
    "ragged set": ("10 00 10 00 06 0C 00 01 00 09 00 01 00 00 00 00 08 98", "90 03"),
    "ramp": ("10 00 10 00 05 0A 00 01 00 09 00 01 03 E9 00 00", "90 03"),
    "level": (f"{_LOUD} 27 11 00 00 00 00", "90 03"),
    "reserved flag": (f"{_LOUD} 03 E8 00 00 00 04", "90 03"),
    "disarmed": (f"{_LOUD} 03 E8 00 00 00 00", "90 04"),
    "envelope length": ("10 00 66 00 03 06 00 05 00 32 00 02", "90 03"),
    "envelope slot": ("10 00 66 00 03 06 00 00 00 32 00 00", "90 03"),
}


@pytest.mark.parametrize("read", ["03 E8 00 7E", "07 6E 00 01"], ids=["126", "not there"])
async def test_modbus_read_write_is_atomic(tcp: FarSide, read: str) -> None:
    """Function 23 is one transaction: with a range that cannot be read, nothing of it is done."""
    async with Master(tcp.url) as master:
        pdu = bytes.fromhex(f"17 {read} 00 02 00 04 08 00 0F 00 FA 00 00 00 09")  # and ARM
        master.send(struct.pack(">HHHB", 5, 0, len(pdu) + 1, 1) + pdu)
        assert (await master.receive(9))[7] == 0x97
        assert tcp.amplifier.state is AmplifierState.SWITCH_ON_DISABLED


@pytest.mark.parametrize(("request_", "answer"), EXCEPTIONS.values(), ids=EXCEPTIONS)
async def test_modbus_exceptions(tcp: FarSide, request_: str, answer: str) -> None:
    """The PDU gets the exception of the standard, and nothing has changed."""
    async with Master(tcp.url) as master:
        before = tcp.device.status()
        pdu, expected = bytes.fromhex(request_), bytes.fromhex(answer)
        master.send(struct.pack(">HHHB", 77, 0, len(pdu) + 1, 1) + pdu)
        assert await master.receive(9) == struct.pack(">HHHB", 77, 0, 3, 1) + expected
        after = tcp.device.status()
        assert (after.state, after.token, after.levels) == (
            before.state,
            before.token,
            before.levels,
        )


async def test_modbus_exceptions_do_not_feed_the_watchdog(tcp: FarSide) -> None:
    """Refusals without end, of every kind: the watchdog trips at its time all the same."""
    client = await foreign_client(tcp.url)
    await client.write_registers(2, [MAP["controlwords"]["ARM"], 100, 0, 9], device_id=1)
    armed = time.monotonic()
    refused = 0
    while tcp.amplifier.state is AmplifierState.OPERATION_ENABLED and time.monotonic() < armed + 5:
        for address, words in ((16, [999, 9]), (10, [8]), (2, [7]), (1002, [4])):
            refused += (await client.write_registers(address, words, device_id=1)).isError()
        await client.read_input_registers(STATUS, count=26, device_id=1)
    assert refused >= 3
    assert tcp.amplifier.fault is Fault.WATCHDOG
    assert tcp.amplifier._last_fed <= armed
    client.close()


async def foreign_client(url: str) -> AsyncModbusTcpClient:
    """A client that is pymodbus's own."""
    host, _, port = url.removeprefix("modbus+tcp://").partition("/")[0].partition(":")
    client = AsyncModbusTcpClient(host, port=int(port), timeout=TIMEOUT, retries=0)
    assert await client.connect()
    return client


async def test_modbus_identity_by_pymodbus(tcp: FarSide) -> None:
    """The identity block names vendor, product, serial number, firmware and version 2."""
    client = await foreign_client(tcp.url)
    own = tcp.amplifier.identity
    block = await client.read_holding_registers(1066, count=65, device_id=1)
    texts = [
        client.convert_from_registers(block.registers[at : at + 16], client.DATATYPE.STRING)
        for at in range(1, 65, 16)
    ]
    assert block.registers[0] == 1 << 2
    assert texts == [own.vendor, own.product, own.serial_number, own.firmware]
    client.close()


async def test_modbus_set_by_pymodbus(tcp: FarSide) -> None:
    """Arm, a set in one write, its heartbeat and read-back, stop: with and without a tag."""
    client = await foreign_client(tcp.url)
    await client.write_registers(2, [MAP["controlwords"]["ARM"], 1000, 0, 9], device_id=1)
    channels = [2200, 2000, 0, 0, *4 * [0], *4 * [0], 5010, 10000, 0x10000 - 9000, 1]
    written = await client.write_registers(16, [513, 9, 513, 0, 0, *channels], device_id=1)
    assert (written.address, written.count) == (16, 21)
    both = await client.readwrite_registers(
        read_address=1144, read_count=18, write_address=9, values=[4711, 9], device_id=1
    )
    assert both.registers == [513, 4, *channels]
    status = await client.read_input_registers(STATUS, count=14, device_id=1)
    assert status.registers[0] == 4711
    assert status.registers[1:4] == [AmplifierState.OPERATION_ENABLED, Fault.NONE, 513]
    assert status.registers[10:] == [2000, 0, 0, 10000]
    played = tcp.amplifier.outputs[3][0]
    assert (played.frequency, played.start) == (250.5, tcp.amplifier.outputs[0][0].start)
    again = await client.write_registers(16, [513, 9], device_id=1)
    assert not again.isError()
    await client.write_registers(2, [MAP["controlwords"]["STOP"]], device_id=1)
    async with asyncio.timeout(TIMEOUT):
        while True:
            status = await client.read_input_registers(STATUS, count=14, device_id=1)
            assert status.registers[1] == AmplifierState.QUICK_STOP_ACTIVE
            if not any(status.registers[10:]):
                break
    client.close()


async def test_modbus_set_by_minimalmodbus(rtu: FarSide) -> None:
    """A master that is not ours drives the amplifier over the serial line, register by register."""
    await asyncio.to_thread(play_with_minimalmodbus, rtu.url)
    assert rtu.amplifier.state is AmplifierState.SWITCH_ON_DISABLED
    assert rtu.amplifier.fault is Fault.NONE


def play_with_minimalmodbus(url: str) -> None:
    """Identity, arm, set, heartbeat, read-back, refusal, disarm, clear."""
    path = url.removeprefix("modbus+rtu://").partition("?")[0]
    master = minimalmodbus.Instrument(path, 1)
    assert master.serial is not None
    master.serial.timeout = 0.5  # s; it waits so long for the rest of what is an exception
    try:
        assert master.read_string(1067, 16, functioncode=4).rstrip("\0") == "era-haptics"
        assert master.read_register(1352, functioncode=4) == 4
        assert master.read_register(1354, functioncode=4) == 65535
        master.write_registers(2, [MAP["controlwords"]["ARM"], 2000, 0, 9])
        master.write_registers(16, [7, 9, 7, 0, 0, 2200, 5000, 0, 0])
        master.write_registers(10, [9])
        assert master.read_registers(STATUS, 4, functioncode=3)[1:] == [4, 0, 7]
        assert master.read_register(LEVELS, 4, functioncode=4) == pytest.approx(0.5)
        assert master.read_register(1007, 1, functioncode=4, signed=True) >= 25.0
        with pytest.raises(minimalmodbus.IllegalRequestError):
            master.write_registers(16, [8, 9])
        assert master.read_register(1034, functioncode=4) == NakCode.BAD_TOKEN
        master.write_registers(2, [MAP["controlwords"]["DISARM"]])
        time.sleep(0.02)
        assert master.read_register(1002, functioncode=4) == AmplifierState.SWITCH_ON_DISABLED
    finally:
        master.serial.close()


async def test_modbus_rtu_unknown_function_ends_with_a_pause() -> None:
    """Over RTU its length is not known: exception 1 comes once the line is silent."""
    device = ScriptedDevice()
    async with scripted("RTU", device) as master:
        body = bytes([1, 0x41, 1, 2, 3])
        master.send(body + struct.pack("<H", crc(body)))
        expected = bytes([1, 0xC1, 1])
        assert await master.receive(5) == expected + struct.pack("<H", crc(expected))


async def test_modbus_tcp_disconnects_a_client_that_does_not_read() -> None:
    """Its answers fill no memory, and others are served meanwhile."""
    device = ScriptedDevice()
    end = ModbusTcpEnd([device])
    await end.start()
    host, _, port = end.urls["main"].removeprefix("modbus+tcp://").partition("/")[0].partition(":")
    hello = FRAMES["Hello request, TCP"]
    with socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        deaf.setblocking(False)
        loop = asyncio.get_running_loop()
        await loop.sock_connect(deaf, (host, int(port)))

        async def ask_on() -> None:
            while True:
                await loop.sock_sendall(deaf, hello * 50)
                await asyncio.sleep(0)

        with pytest.raises(OSError, match=r"reset|pipe"):
            await asyncio.wait_for(ask_on(), TIMEOUT)
    assert not end.connections
    async with Master(end.urls["main"]) as master:
        master.send(hello)
        await master.receive(len(FRAMES["Hello reply, TCP"]))
    await end.close()


async def test_modbus_tcp_limits_connections() -> None:
    """The seventeenth connection is closed at once; the first ones continue."""
    end = ModbusTcpEnd([ScriptedDevice()])
    await end.start()
    async with contextlib.AsyncExitStack() as stack:
        masters = [await stack.enter_async_context(Master(end.urls["main"])) for _ in range(20)]
        masters[0].send(FRAMES["Hello request, TCP"])
        await masters[0].receive(len(FRAMES["Hello reply, TCP"]))
        assert len(end.connections) == 16
    await end.close()
