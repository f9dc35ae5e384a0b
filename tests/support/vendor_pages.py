"""The exchanges that the pages for vendors show, and an amplifier that replies by script."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.guard import Guard, GuardLimits
from drivers.protocol.messages import (
    Achieved,
    AddressSet,
    AmplifierEvent,
    AmplifierState,
    Apply,
    Arm,
    Broadcast,
    Capabilities,
    ChannelLimits,
    Clear,
    Commit,
    Disarm,
    Fault,
    FaultList,
    FaultRecord,
    Feature,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Measure,
    Measured,
    Measurement,
    Nak,
    NakCode,
    Ping,
    Reading,
    ReadingState,
    Reply,
    Request,
    SampleBlock,
    Sensor,
    SensorList,
    SensorReading,
    SensorUnit,
    SetAddress,
    Stage,
    Status,
    Stop,
    ToneReading,
)
from sim.faults.fault_window import Faults

CAPABILITIES = Capabilities(
    *(4, 20.0, 600.0, 0.05, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 16, 0.001, 0.1),
    channel_limits=(ChannelLimits(20.0, 600.0, 1.0),) * 3 + (ChannelLimits(20.0, 500.0, 1.0),),
    features=Feature.WHOLE
    | Feature.BROADCAST
    | Feature.INTERLOCK
    | Feature.ELECTRICAL
    | Feature.SENSORS
    | Feature.ADDRESS,
    voices=4,
)
IDENTITY = Identity("Acme", "Quad", "A-17", "1.2", (2,))
SESSION = 9
COMMANDS = (
    DriveCommand(channel=0, frequency=110.0, level=0.2, phase=0.0),
    DriveCommand(channel=3, frequency=250.5, level=1.0, phase=-90.0, keep_phase=True),
)
GUARD = Guard(GuardLimits(20.0, 600.0, 1.0), CAPABILITIES)
SET = GUARD.check(CommandSet(token=513, commands=COMMANDS, ramp=0.02, valid_for=0.5))
SHAPE = GUARD.check_envelope(Envelope(slot=5, step=0.005, knots=(Knot(0.1, 90), Knot(1, -0.01))))
GUARD.check_envelope(Envelope(slot=6, step=0.005, knots=(Knot(0.1, 0),)))
SHAPED_COMMANDS = (DriveCommand(0, 110.0, 0.2, onset=5, ending=6),)
SHAPED = GUARD.check(CommandSet(514, SHAPED_COMMANDS, ramp=0.0, valid_for=0.0))
MEASURED = Measured(
    (
        Measurement(402.5, 139e-6),
        *(Measurement(0.0, 0.0),) * 2,
        Measurement(1272.8, 0.001002),
    )
)
SENSORS = (
    Sensor(SensorUnit.ACCELERATION, 0, None, None, 512.0, 1000.0, 8000, 1 / 64),
    Sensor(SensorUnit.ACCELERATION, None, 0.25, 0.18, 512.0, 1000.0, 8000, 1 / 64),
)
BEGUN = Reading(1234, ReadingState.RUNNING, 0.2, 1.5, 513, 2)
READ = replace(
    BEGUN,
    state=ReadingState.COMPLETE,
    left=0.0,
    sensors=(
        SensorReading((ToneReading(12.5, -170.25), ToneReading(0.25, 35.5))),
        SensorReading((ToneReading(3.0, -180.0), ToneReading(0.0, 0.0)), is_overloaded=True),
    ),
)
SAMPLES = SampleBlock(1234, 1595, 1600, (800, -1, 32767, -32768, 0))
S = AmplifierState
OFF = Status(S.SWITCH_ON_DISABLED, Fault.NONE, 0, False, 25.0, 0.0, (0.0,) * 4)
ARMED = Status(S.OPERATION_ENABLED, Fault.NONE, 0, True, 25.0, 0.25, (0.0,) * 4, 1800.0)
LEVELS = (0.2, 0.0, 0.0, 1.0)
PLAYING = Status(S.OPERATION_ENABLED, Fault.NONE, 513, True, 25.0, 0.25, LEVELS, 1800.0)
FADING = Status(S.SWITCHED_ON, Fault.NONE, 513, True, 25.0, 0.0, LEVELS, 1800.0)
STOPPED = Status(S.QUICK_STOP_ACTIVE, Fault.NONE, 513, True, 25.0, 0.0, LEVELS, 1800.0, 1)
HALTED = Status(S.QUICK_STOP_ACTIVE, Fault.NONE, 513, True, 25.0, 0.0, (0.0,) * 4, 1800.0, 1)
TRIPPED = Status(S.FAULT, Fault.WATCHDOG, 513, False, -5.3, 0.0, (0.0,) * 4, latch=2)
CLEARED = Status(S.SWITCH_ON_DISABLED, Fault.NONE, 513, False, 25.0, 0.0, (0.0,) * 4, latch=2)


@dataclass(frozen=True)
class Example:
    """One exchange of a page; status: of the amplifier afterwards."""

    request: Request
    reply: Reply
    status: Status = PLAYING


# In the order of the Modbus page, whose tags and transactions count from 1.
EXAMPLES: dict[str, Example] = {
    "Hello": Example(Hello(), IDENTITY, OFF),
    "GetCaps": Example(GetCaps(), CAPABILITIES, OFF),
    "Arm": Example(Arm(watchdog=0.25, session=SESSION), ARMED, ARMED),
    "Apply": Example(Apply(SET, SESSION), Achieved(513, COMMANDS)),
    "Ping": Example(Ping(SESSION), PLAYING),
    "Stage": Example(Stage(SET, SESSION), Achieved(513, COMMANDS), ARMED),
    "Commit": Example(Commit(513, SESSION), Achieved(513, COMMANDS)),
    "LoadEnvelope": Example(LoadEnvelope(SHAPE), Loaded(slot=5, knots=2)),
    "Shaped Apply": Example(Apply(SHAPED, SESSION), Achieved(514, SHAPED_COMMANDS)),
    "Refused Apply": Example(Apply(SET, SESSION), Nak(NakCode.BAD_CHANNEL, 3)),
    "Disarm": Example(Disarm(ramp=0.05), FADING, FADING),
    "Stop": Example(Stop(ramp=0.005), STOPPED, STOPPED),
    "GetStatus": Example(GetStatus(), TRIPPED, TRIPPED),
    "GetFaults": Example(
        GetFaults(),
        FaultList((FaultRecord(Fault.WATCHDOG, None, 1.5), FaultRecord(Fault.ARC, 2, 65.536))),
        TRIPPED,
    ),
    "GetMeasured": Example(GetMeasured(), MEASURED),
    "SetAddress": Example(SetAddress(5, "A-17"), AddressSet(5), OFF),
    "Clear": Example(Clear(latch=2), CLEARED, CLEARED),
    "GetSensors": Example(GetSensors(), SensorList(2, SENSORS)),
    "Measure": Example(Measure(1234, 0.2, (110.0, 250.5)), BEGUN),
    "GetReading": Example(GetReading(), READ),
    "GetBlock": Example(GetBlock(1, 1595), SAMPLES),
}


def plain(request: Request) -> Request:
    """Return a request with plain contents, as decoders make them."""
    match request:
        case Stage(command_set=safe) | Apply(command_set=safe):
            wanted = CommandSet(safe.token, safe.commands, safe.ramp, safe.valid_for)
            return type(request)(wanted, request.session)
        case LoadEnvelope(envelope=safe):
            return LoadEnvelope(Envelope(safe.slot, safe.step, safe.knots))
        case _:
            return request


def usual_reply(request: Request) -> Reply:
    """Reply as a well-behaved, armed amplifier."""
    match request:
        case Hello():
            return IDENTITY
        case GetCaps():
            return CAPABILITIES
        case GetFaults():
            return FaultList(())
        case GetMeasured():
            return MEASURED
        case GetSensors(first=first):
            return SensorList(2, SENSORS[first:])
        case Measure():
            return BEGUN
        case GetReading(first=first):
            return replace(READ, sensors=READ.sensors[first:])
        case GetBlock():
            return SAMPLES
        case SetAddress(address=address):
            return AddressSet(address)
        case Stage(command_set=wanted) | Apply(command_set=wanted):
            return Achieved(wanted.token, wanted.commands)
        case Commit(token=token):
            return Achieved(token, COMMANDS)
        case LoadEnvelope(envelope=envelope):
            return Loaded(envelope.slot, len(envelope.knots))
        case Disarm() | Clear():
            return OFF
        case Stop():
            return HALTED
        case _:
            return ARMED


class ScriptedSensors:
    """Sensors of a simulated amplifier with the replies of the pages."""

    def __init__(self, sensors: Sequence[Sensor] = SENSORS) -> None:
        self._sensors = tuple(sensors)

    def handle(self, request: Request, now: float) -> Reply:
        if isinstance(request, GetSensors):
            return SensorList(len(self._sensors), self._sensors[request.first :])
        return usual_reply(request)

    def changed(self, moment: float) -> None:
        """Nothing is being measured."""

    def forget(self) -> None:
        """Nothing is kept."""


class ScriptedDevice:
    """An amplifier with scripted replies that records its requests."""

    name = "main"

    def __init__(self, *, address: int = 1) -> None:
        self.address = address
        self.faults = Faults()
        self.is_answering = True
        self.asked: list[Request] = []
        self.heard: list[Broadcast] = []
        self.answer: Callable[[Request], Reply | None] = usual_reply

    def follow(self, example: Example) -> None:
        self.answer = lambda request: (
            example.status
            if isinstance(request, GetStatus) and not isinstance(example.request, GetStatus)
            else example.reply
        )

    def exchange(self, request: Request) -> Reply | None:
        self.asked.append(request)
        return self.answer(request)

    def broadcast(self, request: Broadcast) -> Reply | None:
        self.heard.append(request)
        return None

    def on_plug(self, on_plug: Callable[[bool], None]) -> None:
        """Stay plugged in."""

    def listen(self, on_event: Callable[[AmplifierEvent], None]) -> None:
        """Send no events."""
