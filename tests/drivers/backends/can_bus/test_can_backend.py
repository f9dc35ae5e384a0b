"""The CAN backend, beyond the contract of every wire."""

import asyncio
import contextlib
import itertools
import logging
import os
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import can
import pytest

from drivers.amplifier import Amplifier
from drivers.backends.can_bus import interfaces
from drivers.backends.can_bus.backend import CanBackend
from drivers.backends.can_bus.bus import can_bus
from drivers.backends.can_bus.pending import PendingRequests
from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.objects import index_of
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandRefused, FrameError, LinkError, LinkTimeout
from drivers.guard import Guard, GuardLimits
from drivers.protocol.messages import AmplifierEvent, AmplifierState, Apply, Arm, Fault, Hello, Ping
from drivers.urls.can_bus import CanUrl
from model.rig.rig import Rig
from sim.amplifier.sensor_messages import SensedAmplifier
from sim.bench.bench import Bench
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.can_bus import sdo
from sim.far_ends.can_bus.bus import CanBus
from sim.far_ends.can_bus.ends import nodes_on
from sim.far_ends.can_bus.node import CanNode
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from wires import FarSide, far_side, patient, tones

PATIENCE = 60.0  # s; for a busy machine
_NUMBERS = itertools.count()
LIMITS = GuardLimits(20.0, 600.0, 1.0)


class Gateway:
    """Joins a far end's bus with a virtual one of python-can; `sent`: by hosts."""

    def __init__(self, bus: CanBus) -> None:
        self.sent: list[CanFrame] = []
        self.bus = bus
        self.channel = f"test-{next(_NUMBERS)}"
        self.virtual = can.Bus(interface="virtual", channel=self.channel, ignore_config=True)
        self.passing = True  # frames to hosts
        self.listening = True  # frames from hosts
        self._loop = asyncio.get_running_loop()
        self._listener = self.say
        bus.join(self._listener)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._closing = False
        self._thread.start()

    def say(self, frame: CanFrame) -> None:
        if self.passing:
            self.virtual.send(
                can.Message(
                    arbitration_id=frame.id,
                    data=frame.data,
                    is_fd=frame.fd,
                    is_extended_id=False,
                )
            )

    def _read(self) -> None:
        while not self._closing:
            message = self.virtual.recv(0.05)
            if message is not None:
                frame = CanFrame(message.arbitration_id, bytes(message.data), fd=message.is_fd)
                self._loop.call_soon_threadsafe(self._pass, frame)

    def _pass(self, frame: CanFrame) -> None:
        self.sent.append(frame)
        if self.listening:
            self.bus.send(frame, sender=self._listener)

    async def close(self) -> None:
        self._closing = True
        await asyncio.to_thread(self._thread.join)
        self.virtual.shutdown()


@dataclass
class Virtual:
    """Amplifiers on a virtual bus within this process."""

    gateway: Gateway
    far: FarSide

    def url(self, node: int = 1, options: str = "") -> str:
        return f"can+python-can://virtual/{self.gateway.channel}{options}#{node}"


@asynccontextmanager
async def virtual_side(rig: Rig) -> AsyncIterator[Virtual]:
    """The amplifiers of a rig on a virtual bus."""
    bench = Bench(rig, now=time.monotonic(), make_amplifier=SensedAmplifier)
    devices = {name: SimulatedDevice(bench, name) for name in bench.amplifiers}
    bus = CanBus()
    async with nodes_on(bus, list(devices.values())):
        gateway = Gateway(bus)
        try:
            yield Virtual(gateway, FarSide({}, devices, bench))
        finally:
            await gateway.close()
            for device in devices.values():
                device.close()


@pytest.fixture
async def virtual(coarse_rig: Rig) -> AsyncIterator[Virtual]:
    """The paper's amplifier, node 1 of a virtual bus."""
    async with virtual_side(coarse_rig) as virtual:
        yield virtual


@asynccontextmanager
async def opened(url: str, *, reply_timeout: float = 0.5) -> AsyncIterator[Amplifier]:
    """An open amplifier."""
    amplifier = Amplifier(CanBackend(url), reply_timeout=reply_timeout)
    await amplifier.open()
    try:
        yield amplifier
    finally:
        await amplifier.close()


SHAPE = Envelope(7, 0.005, tuple(Knot(0.01 * number, 10.0 * number) for number in range(32)))


async def eventually(condition: Callable[[], object]) -> None:
    """Wait for a condition."""
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110  there is no notification
            await asyncio.sleep(0.002)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("can+socketcand://127.0.0.1:1/can0#1", "check address and port"),
        ("can+slcan:///dev/no-such-port#1", "adapter"),
        ("can+socketcan://no-such-can#1", "ip link"),
    ],
)
async def test_open_fails_with_a_remedy_when_there_is_no_bus(url: str, words: str) -> None:
    """A LinkError within seconds."""
    async with asyncio.timeout(PATIENCE):
        with pytest.raises(LinkError, match=words):
            await CanBackend(url).open()


async def test_host_heartbeat_is_sent_by_calls_only(virtual: Virtual) -> None:
    """As many host heartbeats as calls, whatever the time between them."""
    async with opened(virtual.url()) as amplifier:
        await amplifier.arm(2.0)
        for _ in range(3):
            await amplifier.heartbeat()
        await asyncio.sleep(0.15)
        await amplifier.status()
    assert [frame for frame in virtual.gateway.sent if frame.id == 0x77F] == [
        CanFrame(0x77F, b"\x05")
    ] * 3


@pytest.mark.parametrize("kind", ["slcan", "virtual"])
async def test_set_is_one_frame_over_can_fd(kind: str, coarse_rig: Rig) -> None:
    """48 bytes; status, set and faults as over classic CAN."""
    async with virtual_side(coarse_rig) as virtual, far_side(Wire(kind="slcan"), coarse_rig) as far:
        url = virtual.url(options="?fd=2000000")
        if kind == "slcan":
            url = far.url.replace("#", "&fd=2000000#")
        async with opened(url) as amplifier:
            await amplifier.arm(2.0)
            await amplifier.apply(tones(amplifier, 0.1, 0.2, 0.3, 0.4))
            status = await amplifier.heartbeat()
            assert status.levels == pytest.approx((0.1, 0.2, 0.3, 0.4))
        if kind == "virtual":
            sets = [frame for frame in virtual.gateway.sent if len(frame.data) > 8]
            assert [(frame.id, len(frame.data), frame.fd) for frame in sets] == [(0x481, 48, True)]


async def test_achieved_set_is_read_when_it_differs(virtual: Virtual) -> None:
    """A warm amplifier plays half of the level and reports it."""
    async with opened(virtual.url()) as amplifier:
        await amplifier.arm(2.0)
        virtual.far.device.inject_fault(FaultWindow("over_temperature", lasts=60.0))
        wanted = tones(amplifier, 0.4, 0.2)
        achieved = await amplifier.apply(wanted)
        assert achieved.token == wanted.token
        assert [command.level for command in achieved.commands] == pytest.approx([0.2, 0.1])


@pytest.mark.parametrize("takes_blocks", [True, False])
async def test_envelope_is_loaded_in_blocks_or_segments(
    virtual: Virtual, takes_blocks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """131 bytes: by block transfer, or in segments if the amplifier refuses blocks."""
    if not takes_blocks:

        def refuse(self: object, data: bytes) -> None:
            raise sdo.SdoAbort(sdo.UNKNOWN_COMMAND)

        monkeypatch.setattr(sdo.SdoServer, "_block_command", refuse)
    async with opened(virtual.url()) as amplifier:
        guard = Guard(LIMITS, amplifier.capabilities)
        await amplifier.load_envelope(guard.check_envelope(SHAPE))
        kept = virtual.far.amplifier._sets.slots[7]
        assert (kept.step, len(kept.knots)) == (0.005, 32)
        assert kept.knots[31] == Knot(0.31, -50.0)
        await amplifier.arm(2.0)
        command = DriveCommand(0, 110.0, 0.5, onset=7)
        wanted = CommandSet(1, (command,), ramp=0.0, valid_for=0.0)
        assert (await amplifier.apply(guard.check(wanted))).commands[0].onset == 7


@pytest.mark.parametrize("ends", ["refused", "taken"])
async def test_envelope_is_reloaded_when_a_segment_is_lost(
    virtual: Virtual, ends: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Completely, whether the node refuses or accepts the end of the transfer."""
    end, passing = sdo.SdoServer._block_segment, virtual.gateway._pass
    missed: list[CanFrame] = []

    def miss_once(frame: CanFrame) -> None:
        if frame.id == 0x601 and frame.data[0] == 3 and not missed:  # the third segment
            missed.append(frame)
        else:
            passing(frame)

    def take(server: sdo.SdoServer, data: bytes) -> None:
        if len(missed) == 1 and data[0] >> 5 == 6:  # the end of the transfer
            missed.append(CanFrame(0, data))
            server.reset()
            if ends == "refused":
                raise sdo.SdoAbort(0x0504_0004)  # CiA 301: CRC error
            server._send(bytes([0xA1, *bytes(7)]))
        else:
            end(server, data)

    monkeypatch.setattr(sdo.SdoServer, "_block_segment", take)
    async with opened(virtual.url()) as amplifier:
        virtual.gateway._pass = miss_once  # type: ignore[method-assign]
        guard = Guard(LIMITS, amplifier.capabilities)
        await amplifier.load_envelope(guard.check_envelope(SHAPE))
        assert len(missed) == 2
        assert virtual.far.amplifier._sets.slots[7].knots[31] == Knot(0.31, -50.0)
        assert amplifier.statistics.retries == 1


async def test_missing_object_is_a_frame_error(
    virtual: Virtual, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the abort code and a remedy."""

    def has_none(server: sdo.SdoServer, data: bytes) -> None:
        raise sdo.SdoAbort(0x0602_0000)  # CiA 301: the object does not exist

    async with opened(virtual.url()) as amplifier:
        monkeypatch.setattr(sdo.SdoServer, "_begin_upload", has_none)
        with pytest.raises(FrameError, match=r"GetFaults.*node 1 .*0x06020000.*update"):
            await amplifier.faults()


async def test_silent_or_slow_node_is_a_timeout(
    virtual: Virtual, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each with what to check."""
    backend = CanBackend(virtual.url(node=5))
    await backend.open()
    with pytest.raises(LinkTimeout, match=r"node 5 .*has this number"):
        await backend.exchange(Hello(), timeout=0.01)
    monkeypatch.setattr("drivers.backends.can_bus.backend._MAX_SDO_RESPONSES", 0.1)
    with pytest.raises(LinkTimeout, match="timed out; check that the bus"):
        await backend.exchange(Hello(), timeout=0.2)
    await backend.close()


async def test_sdo_timeout_of_the_node_is_retried(
    virtual: Virtual, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node that waited too long for a frame of a busy host says so (0504 0000 h, CiA 301)."""
    begin = sdo.SdoServer._begin_upload
    given_up: list[bytes] = []

    def give_up_once(server: sdo.SdoServer, data: bytes) -> None:
        is_capability = data[1:3] == index_of("capabilities").to_bytes(2, "little")
        if is_capability and not given_up:
            given_up.append(data)
            raise sdo.SdoAbort(0x0504_0000)
        begin(server, data)

    monkeypatch.setattr(sdo.SdoServer, "_begin_upload", give_up_once)
    async with opened(virtual.url()) as amplifier:
        assert amplifier.capabilities.channels == 4
    assert given_up


@pytest.mark.parametrize("how", ["silent", "boot-up", "stopped", "bus-off"])
async def test_lost_node_is_detected_without_a_request(virtual: Virtual, how: str) -> None:
    """Within three of its heartbeats, or at once, also before the first; reported once."""
    options = "?heartbeat=10000" if how == "boot-up" else ""
    losses: list[str] = []
    backend = CanBackend(virtual.url(options=options))
    backend.listen(lambda _: None, losses.append)
    await backend.open()
    await backend.exchange(Hello(), timeout=0.5)
    if how != "boot-up":
        await backend.exchange(Arm(2.0), timeout=0.5)
        await asyncio.sleep(0.06)  # a heartbeat has been received
    begin = asyncio.get_running_loop().time()
    match how:
        case "silent":
            virtual.gateway.passing = False
        case "boot-up":
            virtual.gateway.say(CanFrame(0x701, b"\x00"))
        case "stopped":
            virtual.gateway.say(CanFrame(0x701, b"\x7f"))
        case _:
            virtual.gateway.virtual.send(
                can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8))
            )
    await eventually(lambda: losses)
    if how == "silent":
        assert asyncio.get_running_loop().time() - begin >= 0.09  # one or two may be late
    with pytest.raises(LinkError):
        await backend.exchange(Ping(), timeout=0.5)
    assert len(losses) == 1
    await backend.close()


def descriptors() -> int:
    """Number of open descriptors."""
    return len(list(Path("/dev/fd").iterdir()))


async def served(*says: bytes) -> tuple[str | None, bool]:
    """Open a bus of a server that sends these, each after an element; the error, and leaks."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError):
            for say in says:
                writer.write(say)
                await reader.readuntil(b">")
            await reader.read()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        host, port = server.sockets[0].getsockname()
        before = descriptors()
        backend = CanBackend(f"can+socketcand://{host}:{port}/can0#1")
        problem = None
        try:
            await backend.open()
        except LinkError as error:
            problem = str(error)
        await backend.close()
        with contextlib.suppress(TimeoutError):  # the server closes its side a little later
            await eventually(lambda: descriptors() <= before)
    return problem, descriptors() > before


@pytest.mark.parametrize(
    "says",
    [
        (b"< hi >", b"< ok >", b"< ok >"),
        (b"< hi >< frame 701 1.0 05 >", b"< frame 701 1.5 05 >< ok >", b"< ok >< frame 701 2 05 >"),
    ],
)
async def test_socketcand_frames_may_arrive_during_the_handshake(says: tuple[bytes, ...]) -> None:
    """The bus opens; closed again, nothing leaks."""
    assert await served(*says) == (None, False)


@pytest.mark.parametrize(
    "says",
    [
        (b"",),
        (b"< hi >",),
        (b"SSH-2.0-x\r\n",),
        (b"< hi >", b"< error could not open bus >"),
        (b"<" * 5000,),
    ],
)
async def test_open_fails_when_socketcand_does_not_open_the_bus(
    says: tuple[bytes, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Silent, stuck or another server, or no such bus: a LinkError, and nothing leaks."""
    monkeypatch.setattr("drivers.backends.can_bus.interfaces._CONNECT_TIMEOUT", 0.1)
    problem, has_leak = await served(*says)
    assert "check address and port" in (problem or "")
    assert not has_leak


async def test_closed_socketcand_connection_is_detected_at_once(coarse_rig: Rig) -> None:
    """Without a request, and long before three heartbeats of ten seconds."""
    async with far_side(Wire(kind="socketcand"), coarse_rig) as far:
        url = far.url.replace("#", "?heartbeat=10000#")
        async with opened(url) as amplifier:
            far.device.inject_fault(FaultWindow("unplug"))
            await eventually(lambda: amplifier.is_lost)


async def test_open_refuses_two_nodes_of_one_number(virtual: Virtual) -> None:
    """Two different replies to an identify request."""
    other = replace(virtual.far.amplifier.identity, serial_number="TWIN")
    device = type("Twin", (), {})()
    for name in ("capabilities", "faults", "is_answering", "listen", "status", "exchange"):
        setattr(device, name, getattr(virtual.far.device, name))
    device.identity = other
    bus = virtual.gateway.bus
    twin = CanNode(device, 1, send=lambda frame: bus.send(frame, sender=hear))

    def hear(frame: CanFrame) -> None:
        twin.receive(frame)

    bus.join(hear)
    twin.start()
    amplifier = Amplifier(CanBackend(virtual.url()), reply_timeout=0.5)
    with pytest.raises(LinkError, match="several amplifiers"):
        await amplifier.open()
    bus.leave(hear)
    twin.close()
    await amplifier.open()
    await amplifier.close()


async def test_late_sdo_reply_is_not_a_second_node(virtual: Virtual) -> None:
    """A reply about another object during the check for a second node is ignored."""
    late = CanFrame(0x581, bytes.fromhex("4F 01 10 00 00 00 00 00"))  # of the error register

    def hear(frame: CanFrame) -> None:
        if frame.id == 0x601 and frame.data[:4] == bytes.fromhex("40 18 10 04"):
            virtual.gateway.say(late)

    virtual.gateway.bus.join(hear)
    async with opened(virtual.url()) as amplifier:
        assert amplifier.identity.serial_number == virtual.far.amplifier.identity.serial_number


def test_sequence_numbers_run_from_1_to_255() -> None:
    """255 numbers, then 1 again: 0 is for events."""
    pending = PendingRequests()
    numbers = [pending.next_sequence() for _ in range(3 * 255)]
    assert sorted(numbers) == sorted([*range(1, 256)] * 3)
    assert numbers[:255] == numbers[255:510]


async def test_unknown_channel_is_refused_before_sending(virtual: Virtual) -> None:
    """Its COB-ID would be a command to the next node."""
    async with opened(virtual.url()) as amplifier:
        await amplifier.arm(2.0)
        guard = Guard(LIMITS, replace(amplifier.capabilities, channels=16))
        wanted = CommandSet(1, (DriveCommand(4, 110.0, 0.2),), ramp=0.0, valid_for=0.0)
        before = amplifier.statistics.frames_out
        with pytest.raises(CommandRefused, match="no such channel"):
            await amplifier.apply(guard.check(wanted))
        assert amplifier.statistics.frames_out == before


async def test_arm_refuses_when_another_host_is_heard(virtual: Virtual) -> None:
    """Its heartbeat for this amplifier precedes arming."""
    async with opened(virtual.url()) as amplifier:
        virtual.gateway.say(CanFrame(0x77F, b"\x05"))
        await asyncio.sleep(0.02)
        with pytest.raises(LinkError, match="another program"):
            await amplifier.arm(2.0)


async def test_events_are_reported_once(virtual: Virtual) -> None:
    """Emergencies, and changes of state without a fault."""
    events: list[AmplifierEvent] = []
    async with opened(virtual.url()) as amplifier:
        amplifier.listen(events.append)
        await amplifier.arm(2.0)
        virtual.far.device.inject_fault(FaultWindow("arc"))
        await eventually(lambda: virtual.far.device.status().state is AmplifierState.FAULT)
        await amplifier.clear()
        await eventually(
            lambda: AmplifierEvent(AmplifierState.SWITCH_ON_DISABLED, Fault.NONE) in events
        )
        assert events == [
            AmplifierEvent(AmplifierState.OPERATION_ENABLED, Fault.NONE),
            AmplifierEvent(AmplifierState.FAULT_REACTION_ACTIVE, Fault.ARC),
            AmplifierEvent(AmplifierState.FAULT, Fault.ARC),
            AmplifierEvent(AmplifierState.SWITCH_ON_DISABLED, Fault.NONE),
        ]


async def test_reply_must_match_sequence_action_and_token(virtual: Virtual) -> None:
    """Others change nothing and are counted."""
    async with opened(virtual.url()) as amplifier:
        backend = amplifier._link.backend
        assert isinstance(backend, CanBackend)
        await amplifier.arm(2.0)
        before = backend.counters.unexpected_frames
        virtual.gateway.listening = False  # the amplifier receives nothing and does not reply
        safe = tones(amplifier, 0.3)
        asking = asyncio.create_task(backend.exchange(Apply(safe), timeout=PATIENCE))
        await asyncio.sleep(0)
        sequence, token = backend._pending._sequence, safe.token
        for number, action, named in (
            (sequence % 255 + 1, 1, token),
            (sequence, 2, token),
            (sequence, 1, token % 65535 + 1),
        ):
            answer = bytes([number, action | 8, 4, 255, *named.to_bytes(2, "little"), 0, 0])
            virtual.gateway.say(CanFrame(0x181, answer))
        await eventually(lambda: backend.counters.unexpected_frames == before + 3)
        assert not asking.done()
        answer = bytes([sequence, 1 | 8, 4, 255, *token.to_bytes(2, "little"), 0, 0])
        virtual.gateway.say(CanFrame(0x181, answer))
        assert (await asking).token == token


async def test_exception_of_a_frame_callback_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It does not end the reader."""

    def fail(*frame: object) -> None:
        raise RuntimeError("a bug")

    bus = can_bus(CanUrl.parse("can+python-can://virtual/any#1").bus)
    bus.network.subscribe(0x123, fail)
    with caplog.at_level(logging.DEBUG, "drivers"):
        bus._received(CanFrame(0x123, b""))
    (record,) = [
        record
        for record in caplog.records
        if "can+python-can://virtual/any: frame 123" in record.getMessage()
    ]
    assert record.exc_info is not None
    assert str(record.exc_info[1]) == "a bug"


async def test_exchange_works_on_a_flooded_bus(virtual: Virtual) -> None:
    """Thousands of foreign frames and invalid replies between request and reply."""
    async with opened(patient(virtual.url()), reply_timeout=PATIENCE) as amplifier:
        for number in range(3000):
            virtual.gateway.say(CanFrame(number % 0x700, bytes(number % 9)))
            virtual.gateway.say(CanFrame(0x181, bytes(number % 8)))
            virtual.gateway.say(CanFrame(0x581, bytes(8)))
        assert (await amplifier.status()).state is AmplifierState.SWITCH_ON_DISABLED
        assert amplifier.statistics.invalid_frames >= 3000
        assert await amplifier.faults() == ()


async def test_partial_write_is_completed(coarse_rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """An adapter takes half of a set and, a little later, the rest: nothing is repeated."""
    async with far_side(Wire(kind="slcan"), coarse_rig) as far, opened(far.url) as amplifier:
        await amplifier.arm(2.0)

        def half(opened: int, data: bytes) -> bytes:
            monkeypatch.undo()
            taken = os.write(opened, data[: len(data) // 2])
            monkeypatch.setattr(interfaces, "write_some", nothing)
            return data[taken:]

        def nothing(opened: int, data: bytes) -> bytes:
            monkeypatch.undo()
            return data

        monkeypatch.setattr(interfaces, "write_some", half)
        safe = tones(amplifier, 0.3)
        assert (await amplifier.apply(safe)).token == safe.token
        assert amplifier.statistics.retries == 0
