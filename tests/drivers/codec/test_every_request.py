"""Every request through the codec of every wire."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import pytest

from drivers.codec.can_bus.objects import pack_envelope
from drivers.codec.can_bus.requests import PdoRequest, action_of
from drivers.codec.can_bus.requests import encode_request as encode_can_request
from drivers.codec.modbus import exchanges
from drivers.codec.serial_line.exchanges import encode_request
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.guard import Guard, GuardLimits
from drivers.protocol.messages import (
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    LoadEnvelope,
    Ping,
    Request,
    Stage,
    Stop,
)
from scripted_amplifier import CAPABILITIES

_SHAPES = replace(
    CAPABILITIES,
    envelope_knots=50,
    envelope_slots=63,
    envelope_step_min=0.001,
    envelope_step_max=0.1,
)
_GUARD = Guard(GuardLimits(40.0, 500.0, 0.8), _SHAPES)
_PLAIN = CommandSet(7, (DriveCommand(channel=2, frequency=110.0, level=0.25),), 0.01, 0.0)
_SET = _GUARD.check(_PLAIN)
_ENVELOPE = _GUARD.check_envelope(Envelope(5, 0.005, (Knot(0.1, 90.0),)))

EXAMPLES: dict[type, Request] = {
    type(each): each
    for each in (
        Hello(),
        GetCaps(),
        Arm(watchdog=0.25),
        Disarm(ramp=0.05),
        Stage(_SET),
        Commit(token=7),
        Apply(_SET),
        Stop(ramp=0.005),
        GetStatus(),
        GetFaults(),
        Clear(),
        Ping(),
        LoadEnvelope(_ENVELOPE),
    )
}

# Read and written as objects on CAN; an envelope is, too.
READ_AS_OBJECTS = {Hello, GetCaps, GetFaults}


@pytest.fixture(params=get_args(Request), ids=lambda kind: kind.__name__)
def request_of_each_kind(request: pytest.FixtureRequest) -> Request:
    """One of each kind that `Request` names; a KeyError here asks for an example of a new one."""
    return EXAMPLES[request.param]


UNCHECKED = (Stage(_PLAIN), Apply(_PLAIN), LoadEnvelope(Envelope(5, 0.005, (Knot(0.1, 90.0),))))
ENCODERS: dict[str, Callable[[Any], object]] = {
    "serial": lambda request: encode_request(request, address=1, sequence=1),
    "modbus": lambda request: exchanges.encode_request(request, tag=1),
    "can": lambda request: (
        pack_envelope(request)
        if isinstance(request, LoadEnvelope)
        else encode_can_request(request, node=1, sequence=1)
    ),
}


@pytest.mark.parametrize("wire", ENCODERS)
def test_encoder_refuses_unchecked_sets_and_envelopes(wire: str) -> None:
    """TypeError for whatever has not passed a guard."""
    for request in UNCHECKED:
        with pytest.raises(TypeError, match="Safe"):
            ENCODERS[wire](request)


def test_modbus_exchange_reads_a_block_and_writes_its_tag(
    request_of_each_kind: Request,
) -> None:
    """Each brings a block back; all but those that never change write their tag first."""
    exchange = exchanges.encode_request(request_of_each_kind, tag=4711)
    assert exchange.read.count > 2
    if isinstance(request_of_each_kind, Hello | GetCaps):
        assert exchange.write is None
    else:
        assert exchange.write is not None
        assert exchange.write.registers[0] == 4711


def test_modbus_exchanges_differ() -> None:
    """What is written and read tells them apart."""
    seen = {repr(exchanges.encode_request(each, tag=1)) for each in EXAMPLES.values()}
    assert len(seen) == len(get_args(Request))


def test_can_request_is_an_order_or_an_sdo_transfer(request_of_each_kind: Request) -> None:
    """An order carries its sequence number in its last byte, on CAN FD as well."""
    asked = request_of_each_kind
    if isinstance(asked, LoadEnvelope):
        assert len(pack_envelope(asked)) == 3 + 4
    elif not isinstance(asked, get_args(PdoRequest)):
        assert type(asked) in READ_AS_OBJECTS
    else:
        for fd in (False, True):
            frames = encode_can_request(asked, node=1, sequence=9, fd=fd)
            (order,) = (frame for frame in frames if frame.id == 0x481)
            assert order.data[7] == 9
            assert order.fd is fd


def test_can_actions_differ_except_ping_and_status() -> None:
    """A Ping asks how it is, as GetStatus does, after the host's heartbeat."""
    orders = [each for each in EXAMPLES.values() if isinstance(each, get_args(PdoRequest))]
    assert len({action_of(each) for each in orders}) == len(orders) - 1
    assert action_of(Ping()) == action_of(GetStatus())
