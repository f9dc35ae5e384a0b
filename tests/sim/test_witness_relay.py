"""Relays in real wires."""

import asyncio
import re
import socket

import pytest

from drivers.by_hand.reaching import random_session
from drivers.contents import Layer, Tone
from drivers.opening import Lines
from drivers.protocol.table import STATES
from model.errors import InputError
from model.rig.rig import Rig
from registry.limits import GuardLimits
from rig_on_wire import far_side
from sim.witness.witness import Witness
from sim.witness_relay import parse_endpoint, relays
from wires import WIRES
from witness_config import witness_config


def _witness(url: str, *, level: float) -> Witness:
    times = dict.fromkeys(("slack", "reply", "heartbeat"), 5.0)
    return Witness(witness_config({"main": url}, times_s=times, level=level))


async def _drive(url: str) -> None:
    lines = Lines()
    try:
        amplifier = await lines.amplifier(url, GuardLimits(40.0, 500.0, 1.0), name="main")
        await amplifier.open()
        assert (await amplifier.arm(random_session()))["state"] == STATES["OPERATION_ENABLED"]
        tone = Tone(0, 110.0, 0.4, 90.0)
        await amplifier.stage(1, [Layer(0, (tone,), ramp=0.01)], now=True)
        await amplifier.ping()
        assert (await amplifier.stop()).is_confirmed
        assert (await amplifier.clear())["state"] == STATES["SWITCH_ON_DISABLED"]
    finally:
        await lines.close()


@pytest.mark.parametrize("wire", WIRES)
async def test_relay_shows_a_session_to_the_witness(wire: str, coarse_rig: Rig) -> None:
    """A session passes at a limit of 0.5, and breaks a limit of 0.3."""
    async with far_side(WIRES[wire], coarse_rig) as far:
        for level, broken in ((0.5, set()), (0.3, {"limits"})):
            witness = _witness(far.url, level=level)
            endpoint = parse_endpoint(far.url)
            async with relays([endpoint], [endpoint.location], witness) as (url,):
                assert url != far.url
                await _drive(url)
            found = witness.finish()
            assert {one.invariant for one in found} == broken, [str(one) for one in found]
            assert witness.frames > 10


@pytest.mark.parametrize(
    ("url", "place", "address"),
    [
        ("serial:///dev/ttyUSB0?baud=921600&address=3", "/dev/ttyUSB0", 3),
        ("modbus+tcp://127.0.0.1:5020/2", "127.0.0.1:5020", 2),
        ("modbus+rtu:///dev/ttyS1?baud=19200#7", "/dev/ttyS1", 7),
        ("can+slcan:///dev/ttyACM0?bitrate=500000#5", "/dev/ttyACM0", 5),
        ("can+socketcand://localhost:29536/can0#1", "localhost:29536", 1),
    ],
)
def test_parse_endpoint_splits_a_url(url: str, place: str, address: int) -> None:
    """Location and address are parsed; the relayed URL keeps all else."""
    taken = parse_endpoint(url)
    assert (taken.location, taken.address) == (place, address)
    assert taken.url_via("X").replace("X", place) == url


@pytest.mark.parametrize(
    "url",
    [
        *("sim://rig.yaml", "serial://", "modbus+tcp://host/1", "nonsense"),
        *("serial:///dev/ttyUSB0?address=300", "serial:///dev/ttyUSB0?baud=fast"),
        *("modbus+tcp://127.0.0.1:502/0", "modbus+tcp://127.0.0.1:99999/1"),
        *("can+slcan:///dev/ttyACM0#128", "modbus+rtu:///dev/ttyS1#two"),
    ],
)
def test_parse_endpoint_refuses_an_invalid_url(url: str) -> None:
    """Scheme, location, address and baud rate are checked; the error names the URL."""
    with pytest.raises(InputError, match=re.escape(url)):
        parse_endpoint(url)


async def test_relay_closes_connections_when_the_server_refuses(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The log names the location."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        url = f"modbus+tcp://127.0.0.1:{bound.getsockname()[1]}/1"
        endpoint, witness = parse_endpoint(url), _witness(url, level=0.5)
        async with relays([endpoint], [endpoint.location], witness) as (end,):
            host, _, port = parse_endpoint(end).location.rpartition(":")
            reader, writer = await asyncio.open_connection(host, int(port))
            assert await reader.read() == b""
            writer.close()
    (record,) = caplog.records
    assert parse_endpoint(url).location in record.getMessage()
