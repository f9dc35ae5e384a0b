"""Simulated amplifiers of protocol 4 on real wires: terminals, TCP, CAN servers and adapters.

Those of a rig run in the test's own event loop. Also Modbus masters that are not ours, with what
each does at an amplifier of four channels; damage to the bytes of frames; and Status with one word
more than the table has, as of a later edition of the protocol: a reading that may be 0 or less,
-12 to 60 V in steps of 10 mV, of which 1 on the wire is -12 V.
"""

import asyncio
import contextlib
import random
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, TypeAlias, cast
from urllib.parse import urlsplit

import can
import minimalmodbus
import pytest
from can.interfaces.virtual import VirtualBus
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.pdu import ModbusPDU

from drivers.errors import LinkDegraded, LinkError
from drivers.host.amplifier import WATCHDOG
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import STATES, status_reading
from drivers.protocol.definition import STATUS as DEFINITION_STATUS
from drivers.protocol.records import Record, Values
from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from drivers.wires.wire import reply_words
from kit.clock import MemoryMachine, VirtualLoop, live_in_memory
from kit.set_table import make_rig
from model.rig.rig import Channel, Rig
from registry import threads
from registry.limits import GuardLimits
from sim.amplifier.readings import AmplifierSummary
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.far_ends.simulated_bus import BusNodes, CanBus, SlcanAdapter, SocketcandClient
from sim.far_ends.wire_assignment import FAR_ENDS, SimulatedWire, open_wires
from sim.faults import Faults
from sim.plant.imperfections import Imperfections
from sim.transport.serving import TcpEnd, TerminalEnd


@dataclass
class FarSide:
    """The far side of a wire: URLs and devices by the amplifiers' names, and the bench behind.

    machine: whose lines they are in virtual time.
    """

    urls: Mapping[str, str]
    devices: Mapping[str, AmplifierDevice]
    bench: Bench
    machine: MemoryMachine | None

    @property
    def url(self) -> str:
        """Of the only amplifier, or the first."""
        return next(iter(self.urls.values()))

    @property
    def device(self) -> AmplifierDevice:
        """The only one, or the first."""
        return next(iter(self.devices.values()))

    @property
    def amplifier(self) -> SimulatedAmplifier:
        """What stands behind it."""
        return cast(SimulatedAmplifier, self.bench.amplifiers[self.device.name])

    def summary(self, name: str = "") -> AmplifierSummary:
        """State, token and levels of an amplifier now; of the first without a name."""
        self.bench.advance(threads.now())
        found = self.bench.amplifiers[name or self.device.name]
        return found.summary(self.bench.time)


def after_each(
    device: AmplifierDevice, note: Callable[[str, Values, Values, float], object]
) -> None:
    """Call with each request that a device carries out: its name, values, reply and time [s]."""
    obey = device.handle

    def handle(name: str, values: Values, now: float) -> Values:
        reply = obey(name, values, now)  # a refusal changes nothing
        note(name, values, reply, now)
        return reply

    device.handle = handle  # type: ignore[method-assign]


@asynccontextmanager
async def far_side(
    wire: SimulatedWire | Mapping[str, SimulatedWire],
    rig: Rig,
    *,
    seed: int = 0,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> AsyncIterator[FarSide]:
    """The amplifiers of a rig behind a wire, without faults until a test injects them.

    wire: of all of them, or of each by name; of memory in virtual time.
    """
    is_virtual = isinstance(asyncio.get_running_loop(), VirtualLoop)
    machine = live_in_memory() if is_virtual else None
    bench, devices = make_bench(rig, seed=seed, imperfections=imperfections)
    wires = dict.fromkeys(bench.amplifiers, wire) if isinstance(wire, SimulatedWire) else wire
    if machine is not None and len(bench.amplifiers) > 1:
        machine.be_prompt()  # the lines have delays of their kinds
    async with open_wires(wires, [*devices.values()]) as urls:
        try:
            yield FarSide(urls, devices, bench, machine)
        finally:
            for device in devices.values():
                device.close()


def make_bench(
    rig: Rig,
    *,
    seed: int = 0,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> tuple[Bench, dict[str, AmplifierDevice]]:
    """A bench, and a device for each amplifier at addresses 1, 2, ..., without faults as yet."""
    bench = Bench(rig, now=threads.now(), imperfections=imperfections)
    return bench, {
        name: AmplifierDevice(
            bench, name, address=number, faults=Faults(begin=threads.now(), seed=seed)
        )
        for number, name in enumerate(bench.amplifiers, start=1)
    }


WIRES: Mapping[str, SimulatedWire] = {
    far_end.scheme: SimulatedWire(kind, unpluggable=True) for kind, far_end in FAR_ENDS.items()
}
"""A wire with a far end of each kind, by the scheme of its URLs."""

SHARED_WIRES: Mapping[str, SimulatedWire] = {
    far_end.scheme: SimulatedWire(kind, shared=True) for kind, far_end in FAR_ENDS.items()
}
"""The same with several amplifiers on one line, where they hear one broadcast."""


def on_amplifiers(rig: Rig, names: Sequence[str]) -> Rig:
    """Wire the ERAs of a rig to amplifiers of these names in turn."""
    count = len(names)
    wiring = {
        era: Channel(names[number % count], number // count)
        for number, era in enumerate(rig.wiring)
    }
    amplifiers, outputs = dict.fromkeys(names, "sim://"), frozenset(names if rig.outputs else ())
    return replace(rig, wiring=wiring, amplifiers=amplifiers, outputs=outputs)


def on_two_amplifiers(rig: Rig) -> Rig:
    """Wire the ERAs of a rig to two amplifiers, east and west, in turn."""
    return on_amplifiers(rig, ("east", "west"))


LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@dataclass
class HostedRig(FarSide):
    """The far side of a wire, and the group of its hosts.

    watchdog [s]: of the group, also when it is opened again.
    """

    lines: Lines
    group: Group
    watchdog: float

    def levels(self, name: str) -> tuple[float, ...]:
        """What the channels of an amplifier play now."""
        return self.summary(name).levels

    async def reopen(self, *, within: float) -> None:
        """Close the lines, and open them again once they are there, within so many seconds."""
        await self.lines.close()
        async with asyncio.timeout(within):
            while True:
                with contextlib.suppress(LinkError):
                    self.group = await _opened_group(self.lines, self.urls, self.watchdog)
                    return
                await self.lines.close()
                await asyncio.sleep(0.05)

    async def beat_until(self, time: float) -> None:
        """Feed the watchdogs of those that reply until a time [s]."""
        while (left := time - threads.now()) > 0:
            await asyncio.sleep(min(left, 0.1))
            with contextlib.suppress(LinkDegraded):
                await self.group.beat()


@asynccontextmanager
async def rig_on_wire(
    rig: Rig, wire: SimulatedWire, *, watchdog: float = WATCHDOG
) -> AsyncIterator[HostedRig]:
    """The amplifiers of a rig on a wire, identified and disarmed; watchdog [s]."""
    async with far_side(wire, rig) as far:
        lines = Lines()
        try:
            group = await _opened_group(lines, far.urls, watchdog)
            yield HostedRig(far.urls, far.devices, far.bench, far.machine, lines, group, watchdog)
        finally:
            await lines.close()


async def _opened_group(lines: Lines, urls: Mapping[str, str], watchdog: float) -> Group:
    """A group of the amplifiers at these URLs, identified and disarmed."""
    group = Group(
        {name: await lines.amplifier(url, LIMITS, name=name) for name, url in urls.items()},
        watchdog=watchdog,
    )
    await group.open()
    return group


def layer(
    *tones: tuple[int, float, float] | tuple[int, float, float, float],
    number: int = 0,
    ramp: float = 0.02,
) -> AmplifierLayer:
    """A layer that plays tones of channel, frequency [Hz], level and perhaps phase [degrees]."""
    return AmplifierLayer(number, tuple(AmplifierTone(*tone) for tone in tones), ramp)


async def until(condition: Callable[[], object]) -> None:
    """Let the event loop turn until a condition holds, for a minute at most."""
    async with asyncio.timeout(60.0):
        while not condition():  # noqa: ASYNC110  it has no event
            await asyncio.sleep(0.0)


_READ_TIMEOUT = 0.02  # s; after which the thread of a bus notices its end
Numbered = Mapping[int, AmplifierDevice]


@dataclass
class WordFarSide:
    """Amplifiers by number on a wire; url: of one of them."""

    amplifiers: Mapping[int, SimulatedAmplifier]
    devices: Numbered
    url: Callable[[int], str]

    def unplug(self) -> None:
        """Cut the wire."""
        for plug in self.devices[1].plug_listeners:
            plug(False)

    def level(self, number: int) -> float:
        """What channel 0 of an amplifier plays now."""
        now = asyncio.get_running_loop().time()
        self.devices[number].tick(now)
        return self.amplifiers[number].playback.level(0, now)


def _far_side(count: int, url: Callable[[int], str]) -> WordFarSide:
    """So many of three amplifiers, with one channel each."""
    rig = make_rig("123", GuardLimits(20.0, 1000.0, 1.0))
    wiring = {era: Channel(name, 0) for era, name in zip(rig.wiring, "123", strict=True)}
    bench, devices = make_bench(replace(rig, wiring=wiring))
    shown = {int(name): name for name in "123"[:count]}
    return WordFarSide(
        {number: bench.amplifiers[name] for number, name in shown.items()},
        {number: devices[name] for number, name in shown.items()},
        url,
    )


def _on_bus(
    make_adapter: Callable[..., Any], devices: Numbered, send: Callable[[bytes], None]
) -> Any:
    """The adapter of a bus of its own, with these amplifiers on it."""
    bus = CanBus()
    BusNodes(bus, [*devices.values()])
    return make_adapter(bus, send)


@asynccontextmanager
async def _served(
    end: Callable[..., Any],
    make_end: Callable[..., Any],
    url: Callable[[Any, int], str],
    count: int,
) -> AsyncIterator[WordFarSide]:
    """Serve amplifiers on a pseudo-terminal or a TCP port, to one host after another."""
    far = _far_side(count, lambda number: url(served.port, number))
    async with end(far.devices[1], partial(make_end, far.devices)) as served:
        yield far


_terminal = partial(_served, partial(TerminalEnd, unpluggable=True))
_server = partial(_served, TcpEnd)


@asynccontextmanager
async def _python_can(
    count: int, interface: str, channel: str, **options: int
) -> AsyncIterator[WordFarSide]:
    """Serve amplifiers on a bus of python-can, which a thread reads."""
    loop = asyncio.get_running_loop()
    adapter = can.Bus(interface=interface, channel=channel, **options)
    query = "".join(f"?{name}={value}" for name, value in options.items())
    ending = threading.Event()
    sent: set[tuple[int, bytes]] = set()  # some interfaces return what was sent

    def received(message: can.Message) -> None:
        key = message.arbitration_id, bytes(message.data)
        if key not in sent:
            end.receive(pack_frames([CanFrame(*key)]), loop.time())

    def send(data: bytes) -> None:
        for frame in unpack_frames(data):
            sent.add((frame.id, frame.data))
            adapter.send(
                can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
            )

    def read() -> None:
        while not ending.is_set():
            if (message := adapter.recv(timeout=_READ_TIMEOUT)) is not None:
                loop.call_soon_threadsafe(received, message)

    url = f"can+python-can://{interface}/{channel}{query}#"
    far = _far_side(count, lambda node: f"{url}{node}")
    end = CanAmplifiers(far.devices, send)
    thread = threading.Thread(target=read)
    thread.start()
    try:
        yield far
    finally:
        ending.set()
        thread.join()
        adapter.shutdown()


class HangingBus(VirtualBus):
    """python-can's virtual bus, whose `send` hangs while `hangs`, for ten seconds at most."""

    hangs: ClassVar[bool] = False
    resumed: ClassVar[threading.Condition] = threading.Condition()
    sending: ClassVar[int] = 0
    """Number of calls that hang now."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        kind = type(self)
        with kind.resumed:
            kind.sending += 1
            kind.resumed.wait_for(lambda: not kind.hangs, 10.0)
            kind.sending -= 1
        super().send(msg, timeout)

    @classmethod
    def resume(cls) -> None:
        """Let all calls go on."""
        with cls.resumed:
            cls.hangs = False
            cls.resumed.notify_all()


@contextlib.contextmanager
def hanging_interface() -> Iterator[type[HangingBus]]:
    """Make python-can know the interface `hanging`, as it would from a package."""
    can.interfaces.BACKENDS["hanging"] = (__name__, HangingBus.__name__)
    try:
        yield HangingBus
    finally:
        HangingBus.resume()
        del can.interfaces.BACKENDS["hanging"]


def _free_port() -> int:
    """Return a UDP port that nobody has, so that tests of other processes are not on the bus."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


WORD_WIRES: Mapping[str, Callable[[int], Any]] = {
    "serial": partial(
        _terminal, SerialAmplifiers, lambda port, number: f"serial://{port}?address={number}"
    ),
    "serial+tcp": partial(
        _server,
        SerialAmplifiers,
        lambda port, number: f"serial+tcp://127.0.0.1:{port}?address={number}",
    ),
    "modbus+rtu": partial(
        _terminal,
        partial(ModbusAmplifiers, is_rtu=True),
        lambda port, number: f"modbus+rtu://{port}?baud=19200#{number}",
    ),
    "modbus+tcp": partial(
        _server,
        partial(ModbusAmplifiers, is_rtu=False),
        lambda port, number: f"modbus+tcp://127.0.0.1:{port}/{number}",
    ),
    "modbus+rtu server": partial(
        _server,
        partial(ModbusAmplifiers, is_rtu=True),
        lambda port, number: f"modbus+rtu://127.0.0.1:{port}#{number}",
    ),
    "can+slcan": partial(
        _terminal,
        partial(_on_bus, SlcanAdapter),
        lambda port, node: f"can+slcan://{port}?bitrate=500000#{node}",
    ),
    "can+slcan server": partial(
        _server,
        partial(_on_bus, SlcanAdapter),
        lambda port, node: f"can+slcan://127.0.0.1:{port}#{node}",
    ),
    "can+socketcand": partial(
        _server,
        partial(_on_bus, SocketcandClient),
        lambda port, node: f"can+socketcand://127.0.0.1:{port}/can0#{node}",
    ),
    "can+python-can virtual": lambda count: _python_can(count, "virtual", "plate"),
    "can+python-can udp_multicast": lambda count: _python_can(
        count, "udp_multicast", "239.74.163.2", port=_free_port()
    ),
}
"""Wires by their names: called with the number of amplifiers, at numbers from 1 on."""

TIMEOUT = 5.0  # s; far ends may be processes, on a busy machine
STATUS = 256 * 9 + 128


class MinimalModbus:
    """That of minimalmodbus, on a serial port."""

    def __init__(self, url: str) -> None:
        self._master = minimalmodbus.Instrument(urlsplit(url).path, 1)
        assert self._master.serial is not None
        self._serial = self._master.serial
        self._serial.timeout = 0.5  # s; it waits so long for the rest of what is an exception

    def read(self, first: int, count: int, function: int) -> list[int]:
        return self._master.read_registers(first, count, functioncode=function)

    def write(self, first: int, registers: Sequence[int]) -> None:
        self._master.write_registers(first, [*registers])

    def write_one(self, first: int, register: int) -> None:
        self._master.write_register(first, register, functioncode=6)

    def close(self) -> None:
        self._serial.close()


class Pymodbus:
    """That of pymodbus, on a serial port or over TCP."""

    def __init__(self, url: str) -> None:
        place = urlsplit(url)
        self._client: Any = (
            ModbusTcpClient(place.hostname or "", port=place.port or 0, timeout=TIMEOUT)
            if place.port
            else ModbusSerialClient(place.path, timeout=TIMEOUT)
        )
        assert self._client.connect()

    def read(self, first: int, count: int, function: int) -> list[int]:
        by = {3: self._client.read_holding_registers, 4: self._client.read_input_registers}
        return [*_granted(by[function](first, count=count)).registers]

    def write(self, first: int, registers: Sequence[int]) -> None:
        _granted(self._client.write_registers(first, [*registers]))

    def write_one(self, first: int, register: int) -> None:
        _granted(self._client.write_register(first, register))

    def close(self) -> None:
        self._client.close()


def _granted(response: ModbusPDU) -> ModbusPDU:
    if response.isError():
        raise minimalmodbus.IllegalRequestError(str(response))
    return response


Make: TypeAlias = type[MinimalModbus] | type[Pymodbus]
MASTERS: Mapping[str, tuple[str, Make]] = {
    "minimalmodbus over rtu": ("rtu", MinimalModbus),
    "pymodbus over rtu": ("rtu", Pymodbus),
    "pymodbus over tcp": ("tcp", Pymodbus),
}
"""Each with its line, made of the URL of an amplifier."""


def drive(make: Make, url: str) -> str:
    """Identity, status, arm, a set of one tone, a refusal, stop; returns the vendor."""
    master = make(url)
    try:
        vendor = b"".join(each.to_bytes(2) for each in master.read(1067, 16, 4))
        assert master.read(STATUS + 2, 1, 3) == [STATES["SWITCH_ON_DISABLED"]]
        assert master.read(STATUS + 7, 1, 4) == [250]  # 0.1 degrees C
        master.write(0x300, [1, 9, 2000, 0])
        master.write(0x500, [2, 9, 7, 3, 1, 0, 0, 0x30, 2200, 2000, 0])
        assert master.read(0x580, 5, 3) == [2, 0, 7, 5, 0]
        levels = STATUS + 2 + 11
        assert master.read(levels, 4, 4) == [0, 0, 0, 2000]
        assert master.read(STATUS + 2 + 9, 1, 3) == [7]
        with pytest.raises(minimalmodbus.IllegalRequestError):
            master.write_one(0x900, 1)  # function 6
        master.write(0x800, [3, 0])
        assert master.read(levels, 4, 3) == [0, 0, 0, 0]
        return vendor.rstrip(b"\0").decode()
    finally:
        master.close()


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


LATER = status_reading("later_voltage", "of another supply", -1200, 6000, 100, "V", is_added=True)
WORD = 1201
"""That it states: 0 V."""
AGES = ("older", "same", "newer")
"""Of an amplifier beside its host or its judge."""


def make_of_age(age: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make simulated amplifiers an edition older or newer than who reads them, or the same."""
    later = Record(*DEFINITION_STATUS.fields, LATER)
    if age == "newer":
        monkeypatch.setattr(
            DEFINITION_STATUS, "pack", lambda values: later.pack(values | {LATER.name: WORD})
        )
        return
    for name, value in vars(later).items():
        monkeypatch.setattr(DEFINITION_STATUS, name, value)
    status = SimulatedAmplifier.status
    if age == "same":

        def stating(amplifier: SimulatedAmplifier, now: float) -> Values:
            return {**status(amplifier, now), LATER.name: WORD}

        monkeypatch.setattr(SimulatedAmplifier, "status", stating)


@pytest.fixture(params=AGES)
def age(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The age of simulated amplifiers beside who reads them: one word less, as many, one more."""
    make_of_age(request.param, monkeypatch)
    reply_words.cache_clear()
    yield request.param
    reply_words.cache_clear()
