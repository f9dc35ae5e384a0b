"""The Modbus backend against a scripted server and an independent one."""

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import replace

import pytest
from pymodbus.framer import FramerType
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.amplifier import Amplifier
from drivers.backends.modbus import line as line_of_modbus
from drivers.backends.modbus.backend import ModbusBackend
from drivers.backends.modbus.line import modbus_line
from drivers.codec.modbus.adu import Read, Write
from drivers.errors import FrameError, LinkError, LinkTimeout
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    AmplifierState,
    Apply,
    Arm,
    Fault,
    FaultList,
    FaultRecord,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Loaded,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Stop,
)
from drivers.urls.modbus import ModbusUrl
from modbus_peer import Peer, peer
from sim.far_ends.modbus.frames import RequestAdu as Telegram
from sim.far_ends.modbus.unit import ModbusUnit
from vendor_pages import (
    ARMED,
    CAPABILITIES,
    COMMANDS,
    IDENTITY,
    SET,
    SHAPE,
    TRIPPED,
    ScriptedDevice,
    usual_reply,
)

PATIENCE = 60.0  # s; for a busy machine
SHORT = 0.02  # s; without a reply


@pytest.fixture(params=["TCP", "RTU"])
async def far(request: pytest.FixtureRequest) -> AsyncIterator[Peer]:
    """A scripted amplifier with both kinds of frames, well-behaved by default."""
    async with peer(is_rtu=request.param == "RTU") as far:
        yield far


@pytest.fixture
async def backend(far: Peer) -> AsyncIterator[ModbusBackend]:
    """An open backend to it."""
    backend = ModbusBackend(far.url)
    await backend.open()
    yield backend
    await backend.close()


async def test_timeout_includes_the_line_behind_a_gateway() -> None:
    """At 9600 baud 0.13 s for a set of four and its response."""
    async with peer(is_rtu=False) as far:
        backend = ModbusBackend(f"{far.url}?baud=9600")
        assert backend.wire_times.round_trip(4) == pytest.approx(0.12719, abs=1e-5)
        await backend.open()
        try:
            loop = asyncio.get_running_loop()

            def later(request: Telegram) -> None:
                pdu = far.usual(request)
                loop.call_later(0.035, far.send, request, pdu)

            far.answer = later
            assert await backend.exchange(Ping(), timeout=0.001) == ARMED
        finally:
            await backend.close()


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        (Hello(), IDENTITY),
        (GetCaps(), CAPABILITIES),
        (Arm(0.25, 9), ARMED),
        (Apply(SET), Achieved(513, COMMANDS)),
        (Stage(SET), Achieved(513, COMMANDS)),
        (Ping(), ARMED),
        (GetFaults(), FaultList(())),
        (LoadEnvelope(SHAPE), Loaded(5, 2)),
    ],
    ids=lambda value: type(value).__name__,
)
async def test_request_is_one_transaction(
    far: Peer, backend: ModbusBackend, request_: Request, expected: Reply
) -> None:
    """A block written and one read back by FC23; identity and capabilities are only read."""
    assert await backend.exchange(request_, timeout=PATIENCE) == expected
    assert far.functions == [4 if isinstance(request_, Hello | GetCaps) else 23]
    assert backend.last_sent_at > 0


async def test_many_faults_are_read_in_two_transactions(far: Peer, backend: ModbusBackend) -> None:
    """Newest first, as many as fit into a read."""
    records = tuple(FaultRecord(Fault.ARC, number % 4, float(number)) for number in range(32))
    for count, reads in ((4, 1), (5, 2), (30, 2)):
        far.requests.clear()
        far.device.answer = lambda _, count=count: FaultList(records[:count])
        assert await backend.exchange(GetFaults(), timeout=PATIENCE) == FaultList(records[:count])
        assert len(far.requests) == reads
    far.device.answer = lambda _: FaultList(records)
    answer = await backend.exchange(GetFaults(), timeout=PATIENCE)
    assert answer == FaultList(records[:30])


async def test_fc16_and_fc4_replace_fc23_when_unsupported(
    far: Peer, backend: ModbusBackend
) -> None:
    """Exception 1 to the first request is remembered: from then on 16 (or 6) and 4."""
    far.answer = lambda request: (
        bytes([0x97, 1]) if request.pdu[0] == 23 else far.unit.reply(request.pdu)
    )
    assert await backend.exchange(Apply(SET), timeout=PATIENCE) == Achieved(513, COMMANDS)
    assert await backend.exchange(Ping(), timeout=PATIENCE) == ARMED
    assert far.functions == [23, 16, 4, 16, 4]
    carried_out = [one for one in far.device.asked if not isinstance(one, GetStatus)]
    assert [type(request) for request in carried_out] == [Apply, Ping]


REFUSALS = [code for code in NakCode if code is not NakCode.UNKNOWN_TYPE]  # of an unknown function


@pytest.mark.parametrize("combined", [True, False], ids=["function 23", "functions 16 and 4"])
@pytest.mark.parametrize("code", REFUSALS, ids=lambda code: code.name)
async def test_refusal_has_its_reason(
    far: Peer, backend: ModbusBackend, code: NakCode, combined: bool
) -> None:
    """Whatever the exception; BUSY is unambiguous, the others are read."""
    backend._can_read_back = combined
    far.device.answer = lambda _: Nak(code, 2)
    nak = await backend.exchange(Apply(SET), timeout=PATIENCE)
    is_busy = code is NakCode.BUSY
    assert nak == Nak(code, None if is_busy else 2)
    assert far.functions == [23 if combined else 16, 4][: 1 if is_busy else 2]


async def test_gateway_exception_is_a_timeout(far: Peer, backend: ModbusBackend) -> None:
    """Exceptions 10 and 11; the error names the gateway."""
    for code in (10, 11):
        far.answer = lambda request, code=code: bytes([request.pdu[0] | 0x80, code])
        with pytest.raises(LinkTimeout, match="gateway"):
            await backend.exchange(Ping(), timeout=PATIENCE)


async def test_late_response_is_not_credited_to_the_next_request(
    far: Peer, backend: ModbusBackend
) -> None:
    """It is discarded and counted; the next request gets its own response."""
    late: list[bytes] = []

    def answer(request: Telegram) -> bytes | None:
        pdu = far.usual(request)
        if not late:
            late.append(far.frame(request, pdu))
            return None
        far.send_raw(late[0])
        return pdu

    far.answer = answer
    far.device.answer = lambda _: replace(ARMED, token=1)
    with pytest.raises(LinkTimeout, match="unit 1"):
        await backend.exchange(GetStatus(), timeout=SHORT)
    far.device.answer = lambda _: replace(ARMED, token=2)
    for _ in range(3):  # with copies of the late response
        status = await backend.exchange(GetStatus(), timeout=PATIENCE)
        assert status == replace(ARMED, token=2)
    assert backend.counters.unexpected_frames == 3


async def test_late_exception_is_not_credited_to_the_next_request(
    far: Peer, backend: ModbusBackend
) -> None:
    """An RTU exception has no tag; the tag of the refusal block shows the write it belongs to."""
    late: list[bytes] = []

    def answer(request: Telegram) -> bytes | None:
        pdu = far.usual(request)
        if not late:
            late.append(far.frame(request, pdu))
            return None
        if len(late) == 1:
            late.append(b"")
            far.send_raw(late[0])
        return pdu

    far.answer = answer
    far.device.answer = lambda _: Nak(NakCode.WRONG_STATE)
    with pytest.raises(LinkTimeout):
        await backend.exchange(Apply(SET), timeout=SHORT)
    far.device.answer = usual_reply
    if far.is_rtu:
        with pytest.raises(LinkTimeout, match="without a reason"):
            await backend.exchange(Arm(0.25, 9), timeout=PATIENCE)
    assert await backend.exchange(Arm(0.25, 9), timeout=PATIENCE) == ARMED


async def test_transaction_numbers_and_tags_wrap(far: Peer, backend: ModbusBackend) -> None:
    """After 16 bits."""
    assert backend._line is not None
    backend._line._transaction = backend._tag = 0xFFFF - 1
    for _ in range(3):
        assert await backend.exchange(Arm(0.25, 9), timeout=PATIENCE) == ARMED


async def test_exception_without_a_refusal_is_a_timeout(far: Peer, backend: ModbusBackend) -> None:
    """The write is repeated by the link."""

    def answer(request: Telegram) -> bytes | None:
        pdu = far.requests[-1].pdu
        return far.unit.reply(pdu) if pdu[0] == 4 else bytes([pdu[0] | 0x80, 3])

    far.answer = answer
    with pytest.raises(LinkTimeout, match="without a reason"):
        await backend.exchange(Arm(0.25, 9), timeout=PATIENCE)


def off_by(place: int, bit: int = 1) -> Callable[[bytes], bytes]:
    """Flip one bit of a response."""

    def change(frame: bytes) -> bytes:
        changed = bytearray(frame)
        changed[place] ^= bit
        return bytes(changed)

    return change


@pytest.mark.parametrize("place", range(11))
async def test_damaged_response_is_discarded(far: Peer, backend: ModbusBackend, place: int) -> None:
    """A wrong transaction, protocol, length, unit, function, count or tag; not the next."""
    spoil = off_by(place)

    def answer(request: Telegram) -> bytes | None:
        pdu = far.usual(request)
        asyncio.get_running_loop().call_later(0.01, far.send, request, pdu)
        far.send_raw(spoil(far.frame(request, pdu)))
        return None

    far.answer = answer
    if place == 5 and not far.is_rtu:  # a greater length includes the start of the next frame
        with pytest.raises(LinkTimeout):
            await backend.exchange(Ping(), timeout=0.5)
    else:
        assert await backend.exchange(Ping(), timeout=PATIENCE) == ARMED
    counters = backend.counters
    assert counters.invalid_frames + counters.unexpected_frames >= 1
    far.answer = far.usual
    assert await backend.exchange(Ping(), timeout=PATIENCE) == ARMED


@pytest.mark.parametrize("place", [-4, -3, -2, -1])
async def test_echo_of_another_write_is_discarded(place: int) -> None:
    """FC16 echoes address and count: others do not confirm the write."""
    async with peer(is_rtu=False) as far:
        link = modbus_line(ModbusUrl.parse(far.url))
        await link.join(1, lambda _: None)

        def answer(request: Telegram) -> bytes | None:
            pdu = far.usual(request)
            return off_by(place)(pdu)

        far.answer = answer
        for write in (Write(2, (15, 250, 0, 9)), Write(9, (99, 9))):
            with pytest.raises(LinkTimeout):
                await link.transact(None, write, unit=1, timeout=SHORT, accept=lambda _: True)
        assert link.counters.unexpected_frames == 2
        await link.leave(1)


async def test_response_out_of_range_is_a_frame_error(far: Peer, backend: ModbusBackend) -> None:
    """A valid CRC, but an unknown state or too many channels."""
    await backend.exchange(GetCaps(), timeout=PATIENCE)
    far.device.answer = lambda _: replace(ARMED, state=9)  # type: ignore[arg-type]
    with pytest.raises(FrameError, match="AmplifierState 9"):
        await backend.exchange(Ping(), timeout=PATIENCE)
    far.device.answer = lambda _: replace(ARMED, levels=(0.0,) * 5)
    with pytest.raises(FrameError, match="at most 4, got 5"):
        await backend.exchange(Ping(), timeout=PATIENCE)
    far.device.answer = lambda request: (
        replace(ARMED, levels=(0.0,) * 5)
        if isinstance(request, GetStatus)
        else Achieved(513, COMMANDS)
    )
    with pytest.raises(FrameError, match="at most 4, got 5"):
        await backend.exchange(Apply(SET), timeout=PATIENCE)


async def test_closed_connection_is_detected_at_once(far: Peer, backend: ModbusBackend) -> None:
    """LinkError to requests, and the loss callback without one; closing is safe afterwards."""
    far.answer = lambda _: far.hang_up()
    with pytest.raises(LinkError, match=r"was lost.*open the amplifier again"):
        await backend.exchange(Ping(), timeout=PATIENCE)
    with pytest.raises(LinkError, match="was lost"):
        await backend.exchange(Ping(), timeout=PATIENCE)
    await backend.close()
    lost = asyncio.get_running_loop().create_future()
    backend.listen(lambda _: None, lost.set_result)
    await backend.open()
    far.answer = far.usual
    assert await backend.exchange(Ping(), timeout=PATIENCE) == ARMED
    far.hang_up()
    assert "was lost" in await asyncio.wait_for(lost, PATIENCE)


async def test_refused_connection_has_a_remedy() -> None:
    """With the address."""
    with pytest.raises(LinkError, match=r"127\.0\.0\.1:1: .*check"):
        await ModbusBackend("modbus+tcp://127.0.0.1:1/1").open()


async def test_units_share_one_connection(far: Peer) -> None:
    """One request at a time; the last user closes it."""
    first, second = (
        Amplifier(ModbusBackend(url), reply_timeout=PATIENCE)
        for url in (far.url, far.url[:-1] + "2")
    )
    await first.open(take_over=False)
    await second.open(take_over=False)
    far.requests.clear()
    assert far.connections == 1
    assert first.bus == second.bus
    waiting: list[int] = []

    def answer(request: Telegram) -> bytes | None:
        waiting.append(request.unit)
        assert len(waiting) == 1

        def reply() -> None:
            waiting.clear()
            pdu = far.usual(request)
            far.send(request, pdu)

        asyncio.get_running_loop().call_later(0.003, reply)
        return None

    far.answer = answer
    replies = await asyncio.gather(*(one.heartbeat() for one in (first, second) * 5))
    assert replies == [ARMED] * 10
    assert sorted(request.unit for request in far.requests) == [1] * 5 + [2] * 5
    await first.close()
    assert await second.heartbeat() == ARMED
    await second.close()


async def test_next_request_waits_for_the_response_to_a_cancelled_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Over RTU; not over TCP."""
    monkeypatch.setattr(line_of_modbus, "_REACTION", 60.0)
    for is_rtu in (True, False):
        async with peer(is_rtu=is_rtu) as far:
            backend = ModbusBackend(far.url)
            await backend.open()
            far.answer = lambda _: None
            asking = asyncio.create_task(backend.exchange(Ping(), timeout=PATIENCE))
            await far.count(1)
            asking.cancel()
            await asyncio.gather(asking, return_exceptions=True)
            far.answer = far.usual
            stopping = asyncio.create_task(backend.exchange(Stop(0.0), timeout=PATIENCE))
            await asyncio.sleep(SHORT)
            assert len(far.requests) == (1 if is_rtu else 2)
            far.send(far.requests[0], far.usual(far.requests[0]))
            assert await asyncio.wait_for(stopping, PATIENCE) == ARMED
            await backend.close()


async def test_changes_between_responses_are_events(far: Peer, backend: ModbusBackend) -> None:
    """One per change of state or fault, none for the first response."""
    events: list[AmplifierEvent] = []
    backend.listen(events.append, lambda _: None)
    for status in (ARMED, ARMED, TRIPPED, TRIPPED, ARMED):
        far.device.answer = lambda _, status=status: status
        await backend.exchange(GetStatus(), timeout=PATIENCE)
    assert events == [
        AmplifierEvent(AmplifierState.FAULT, Fault.WATCHDOG),
        AmplifierEvent(AmplifierState.OPERATION_ENABLED, Fault.NONE),
    ]


@pytest.mark.parametrize("framer", [FramerType.SOCKET, FramerType.RTU], ids=["TCP", "RTU"])
async def test_pymodbus_server_accepts_the_requests(framer: FramerType) -> None:
    """An independent implementation answers each function that is used."""
    device = SimDevice(
        1, simdata=[SimData(0, values=list(range(100)), datatype=DataType.REGISTERS)]
    )
    server = ModbusTcpServer(device, framer=framer, address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    port = server.transport.sockets[0].getsockname()[1]
    is_rtu = framer is FramerType.RTU
    scheme, unit = ("modbus+rtu", "#1") if is_rtu else ("modbus+tcp", "/1")
    link = modbus_line(ModbusUrl.parse(f"{scheme}://127.0.0.1:{port}{unit}"))
    await link.join(1, lambda _: None)

    async def ask(read: Read | None, write: Write | None = None) -> object:
        return await link.transact(read, write, unit=1, timeout=PATIENCE, accept=lambda _: True)

    assert (await ask(Read(5, 3))).registers == (5, 6, 7)
    await ask(None, Write(5, (500, 600)))
    await ask(None, Write(7, (700,)))
    both = await ask(Read(5, 4), Write(8, (800, 900)))
    assert both.registers == (500, 600, 700, 800)
    assert (await ask(Read(99, 5))).exception == 2
    assert (await ask(Read(0, 100))).registers[9] == 900
    assert link.counters.invalid_frames == link.counters.unexpected_frames == 0
    await link.leave(1)
    await server.shutdown()


async def test_open_refuses_two_amplifiers_of_one_unit() -> None:
    """Over RTU: two different responses to one Hello; a repeated one is accepted."""
    async with peer(is_rtu=True) as far:
        second = ScriptedDevice()
        second.answer = lambda request: (
            replace(IDENTITY, serial_number="B-18")
            if isinstance(request, Hello)
            else usual_reply(request)
        )
        other = ModbusUnit(second)

        def answered_by(*units: ModbusUnit) -> Callable[[Telegram], None]:
            def answer(request: Telegram) -> None:
                for unit in units:
                    pdu = unit.reply(request.pdu)
                    assert pdu is not None
                    far.send(request, pdu)

            return answer

        far.answer = answered_by(far.unit, other)
        amplifier = Amplifier(ModbusBackend(far.url), reply_timeout=PATIENCE)
        with pytest.raises(LinkError, match=r"several amplifiers .*unit 1"):
            await amplifier.open(take_over=False)
        far.answer = answered_by(far.unit, far.unit)
        await amplifier.open(take_over=False)
        await amplifier.close()
