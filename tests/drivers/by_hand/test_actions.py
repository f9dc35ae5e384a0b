"""Actions of `era amp` on real wires, at simulated amplifiers of version 4."""

import asyncio
import re
from pathlib import Path

import pytest

from drivers.by_hand import actions
from drivers.by_hand.reaching import identify_all
from drivers.errors import CommandError, CommandRefused, LinkError, LinkTimeout
from drivers.opening import Lines
from drivers.playing import Layer, Tone
from drivers.protocol.definition import FEATURES
from drivers.trace import tracing
from drivers.urls import with_address
from real_wires import WORD_WIRES, WordWiresFarSide
from registry.limits import GuardLimits

pytestmark = pytest.mark.real_time
LIMITS = GuardLimits(20.0, 1000.0, 1.0)
OF_CONNECTIONS = ("tcp", "server", "socketcand")
ADDRESSED = [wire for wire in WORD_WIRES if not wire.endswith(OF_CONNECTIONS)]
"""Wires whose far end lasts: the others have one for each connection, at the first addresses."""


async def leave_playing(far: WordWiresFarSide, number: int = 1) -> None:
    """Play at half level, as a host that then ends without a word."""
    lines = Lines()
    amplifier = await lines.amplifier(far.url(number), LIMITS, name="a", is_output=None)
    await amplifier.open()
    await amplifier.arm(77, 2.0)
    await amplifier.stage(5, [Layer(0, (Tone(0, 100.0, 0.5),), 0.0)], now=True)
    await lines.close()
    assert far.level(number) == pytest.approx(0.5)


@pytest.mark.parametrize("wire", WORD_WIRES)
async def test_stop_is_sent_before_anything_is_read(wire: str, tmp_path: Path) -> None:
    """An amplifier that plays for another host is silent, confirmed; identity is read after."""
    async with WORD_WIRES[wire](1) as far:
        await leave_playing(far)
        with tracing(tmp_path / "trace"):
            result = await actions.stop(far.url(1))
        assert far.level(1) == 0.0
        assert (result["silence"], result["cause"]) == ("confirmed_silent", "")
        assert (result["state"], result["levels"]) == ("QUICK_STOP_ACTIVE", [0.0])
    text = (tmp_path / "trace").read_text("utf-8")
    requests = re.findall(r" request (\w+)\(", text)
    assert requests[0] == "Stop"
    assert {"Hello", "GetCaps"} <= set(requests[1:])
    assert re.search(r" wire .* > (?:[0-9a-f]{2} )+ Stop to 1\n", text)
    assert re.search(r" wire .* < (?:[0-9a-f]{2} )+ Reply\(", text)


async def test_stop_of_a_mute_amplifier_may_play() -> None:
    """Nothing replies at its address, so nothing confirms that it is silent."""
    async with WORD_WIRES["serial"](1) as far:
        result = await actions.stop(far.url(2))
    assert (result["silence"], result["may_play_for_s"]) == ("may_play", None)
    assert "no reply" in result["cause"]
    assert "state" not in result


async def test_identity_has_units_and_the_limits_of_the_wire() -> None:
    """Frames of 252 and 18 bytes for the longest part of a set: 120 and 3 words, and 12 bytes each.

    At 115 200 baud these 2700 bits are 23.4 ms, 42 sets a second.
    """
    async with WORD_WIRES["serial"](1) as far:
        rows = await actions.identify(f"{far.url(1)}&baud=115200")
    assert (rows["serial_number"], rows["versions"], rows["channels"]) == ("SIM-1", [4], 1)
    assert (rows["watchdog_min_s"], rows["watchdog_max_s"]) == (0.1, 2.0)
    assert rows["channel_limits"][0].keys() == {
        *("frequency_min_hz", "frequency_max_hz", "level_max")
    }
    assert "events" in rows["features"]
    assert rows["wire_round_trip_s"] == pytest.approx(2700 / 115_200, abs=1e-6)
    assert rows["sets_per_second_max"] == 42
    assert rows["watchdog_shortest_s"] == pytest.approx(0.15 + 2700 / 115_200, abs=1e-6)


@pytest.mark.parametrize("wire", WORD_WIRES)
async def test_status_of_what_plays_and_clear_of_a_stop(wire: str) -> None:
    """Looking changes nothing; after a stop Clear leaves it disarmed.

    What full level means is the rig's business.
    """
    async with WORD_WIRES[wire](2) as far:
        far.amplifiers[2].capabilities["features"] |= 1 << FEATURES["output"]
        await leave_playing(far, 2)
        rows = await actions.status(far.url(2))
        assert (rows["state"], rows["levels"], rows["token"]) == ("OPERATION_ENABLED", [0.5], 5)
        assert rows["layer_tokens"][:2] == [5, 0]
        assert (rows["high_voltage"], rows["interlock_open"], rows["limited"]) == (
            *(True, False, False),
        )
        assert 0 < rows["watchdog_left_s"] <= 2.0
        assert rows["last_round_trip_s"] > 0
        assert 0 <= rows["clock_s"] < 20
        await actions.stop(far.url(2))
        assert (await actions.clear(far.url(2)))["state"] == "SWITCH_ON_DISABLED"


async def test_drive_plays_and_ends_silent_and_disarmed(tmp_path: Path) -> None:
    """What is achieved is what was asked for; pings feed the watchdog meanwhile."""
    async with WORD_WIRES["serial"](1) as far:
        options = {"channel": 0, "frequency": 123.45, "level": 0.3, "duration": 0.3}
        with tracing(tmp_path / "trace"):
            driving = asyncio.ensure_future(actions.drive(far.url(1), **options))
            heard = set()
            while not driving.done():
                heard.add(round(far.level(1), 6))
                await asyncio.sleep(0.01)
            rows = await driving
            assert max(heard) == 0.3
        assert rows["achieved"] == [
            {"channel": 0, "frequency_hz": 123.45, "level": 0.3, "phase_deg": 0.0}
        ]
        assert (rows["state"], rows["levels"]) == ("SWITCH_ON_DISABLED", [0.0])
    requests = re.findall(r" request (\w+)\(", (tmp_path / "trace").read_text("utf-8"))
    assert requests.index("Ping") < requests.index("Disarm")


@pytest.mark.parametrize(
    ("query", "wrong"),
    [
        ("", {"level": 1.1}),
        ("", {"frequency": float("nan")}),
        ("", {"channel": 1}),
        ("", {"duration": 0.0}),
        ("", {"duration": float("nan")}),
        ("&baud=4800", {}),  # too slow for three heartbeats and a round trip
    ],
)
async def test_invalid_drive_never_arms(query: str, wrong: dict[str, float]) -> None:
    """It is bad input and does not change the amplifier."""
    options = {"channel": 0, "frequency": 110.0, "level": 0.2, "duration": 0.1, **wrong}
    async with WORD_WIRES["serial"](1) as far:
        with pytest.raises(CommandError):
            await actions.drive(far.url(1) + query, **options)  # type: ignore[arg-type]
        assert far.amplifiers[1].session == 0


async def test_drive_after_a_stop_names_the_clear_command() -> None:
    """State, fault and remedy, with the URL quoted for a shell."""
    async with WORD_WIRES["serial"](1) as far:
        await actions.stop(far.url(1))
        with pytest.raises(CommandRefused) as refused:
            await actions.drive(far.url(1), channel=0, frequency=110.0, level=0.2, duration=0.1)
    assert "QUICK_STOP_ACTIVE" in str(refused.value)
    assert str(refused.value).endswith(f"era amp clear '{far.url(1)}'")


@pytest.mark.parametrize("wire", ADDRESSED)
async def test_amplifier_takes_another_address(wire: str) -> None:
    """It replies there, nobody where it was, and the other amplifier where it is."""
    async with WORD_WIRES[wire](2) as far:
        moved = await actions.set_address(far.url(1), 9, None)
        assert moved == {"url": with_address(far.url(1), 9), "serial_number": "SIM-1"}
        assert (await actions.identify(moved["url"]))["serial_number"] == "SIM-1"
        assert (await actions.identify(far.url(2)))["serial_number"] == "SIM-2"
        with pytest.raises(LinkTimeout):
            await actions.identify(far.url(1))
        back = await actions.set_address(moved["url"], 10, "SIM-1")
        assert (await actions.identify(back["url"]))["serial_number"] == "SIM-1"


async def test_armed_amplifier_keeps_its_address() -> None:
    """So does one of another serial number; a wire without addresses has none to set."""
    async with WORD_WIRES["serial"](1) as far:
        await leave_playing(far)
        with pytest.raises(CommandRefused, match="disarm"):
            await actions.set_address(far.url(1), 9, None)
        assert far.level(1) == pytest.approx(0.5)
        with pytest.raises(LinkError):
            await actions.set_address(far.url(1), 9, "SIM-nobody")
        assert (await actions.identify(far.url(1)))["serial_number"] == "SIM-1"
    with pytest.raises(CommandError, match="address"):
        await actions.set_address("sim://rig.yaml", 9, None)


async def test_discovery_only_identifies(tmp_path: Path) -> None:
    """A URL without a reply is no error; what plays goes on."""
    async with WORD_WIRES["modbus+rtu"](1) as far:
        await leave_playing(far)
        with tracing(tmp_path / "trace"):
            unreached = ["serial:///dev/no-such-port", "can+socketcand://127.0.0.1:1/can0#1"]
            here, *others = (await identify_all([far.url(1), *unreached])).values()
        assert far.level(1) == pytest.approx(0.5)
    assert isinstance(here, dict)
    assert here["serial_number"] == "SIM-1"
    assert [type(other) for other in others] == [LinkError, LinkError]
    requests = re.findall(r" request (\w+)\(", (tmp_path / "trace").read_text("utf-8"))
    assert set(requests) <= {"Hello", "GetCaps", "GetStatus"}
