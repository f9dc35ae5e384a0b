"""The exchanges that the pages for vendors show, and an amplifier that replies by script."""

from collections.abc import Callable
from dataclasses import dataclass

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
    GetCaps,
    GetFaults,
    GetMeasured,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Measured,
    Measurement,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    SetAddress,
    Stage,
    Status,
    Stop,
)
from sim.faults.fault_window import Faults

CAPABILITIES = Capabilities(
    *(4, 20.0, 600.0, 0.05, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 16, 0.001, 0.1),
    channel_limits=(ChannelLimits(20.0, 600.0, 1.0),) * 3 + (ChannelLimits(20.0, 500.0, 1.0),),
    features=Feature.WHOLE
    | Feature.BROADCAST
    | Feature.INTERLOCK
    | Feature.ELECTRICAL
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
