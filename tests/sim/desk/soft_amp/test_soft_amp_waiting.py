"""A software amplifier without its sound server: it waits, and hosts see a fault meanwhile."""

import asyncio
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from drivers.opening import Lines
from drivers.protocol.definition import FAULTS, STATES
from gateway_bench import wait_for
from sound_cards import BLOCK, SoftAmp, capture_on, host, jack_server
from steady_host import linear_amplifier
from typed_page import ERA

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.needs("jackd", "cc"),
]

CHANNELS = 2
RATE = 96_000  # not the one that is assumed until the server says its own


async def test_amplifier_waits_for_its_server_and_plays_by_the_clock_of_that(
    tmp_path: Path,
) -> None:
    """In fault at first, reported once; then 1 kHz is 1 kHz at a rate that was not stated."""
    name = f"wait{os.getpid()}"
    environment = os.environ | {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    options = ("--device", "jack:card", "--channels", str(CHANNELS), "--link", str(tmp_path / "a"))
    amp = SoftAmp(*options, environment=environment, log=tmp_path / "log")
    lines = Lines()
    amplifier = await linear_amplifier(lines, amp.url)
    await amplifier.open()
    status = await amplifier.read_status()
    assert (status["state"], status["fault"]) == (STATES["FAULT"], FAULTS["INTERNAL"])
    wait_for(lambda: "no server is running" in amp.log)
    await asyncio.sleep(1.5)  # two more attempts
    with jack_server(name, rate=RATE):
        capture = capture_on(name, "card", CHANNELS)
        wait_for(lambda: f"{RATE} Hz, blocks of {BLOCK} frames" in amp.log)
        assert amp.log.count("no server is running") == 1
        assert (await amplifier.read_status())["state"] == STATES["FAULT"]
        assert (await amplifier.clear())["state"] == STATES["SWITCH_ON_DISABLED"]
        await lines.close()
        with host(amp.url, CHANNELS):
            wait_for(capture.is_sounding)
            end = capture.position + 0.3 * RATE  # 0.2 s of soft start and ramp
            wait_for(lambda: capture.position > end)
            samples = capture.samples(RATE // 10)
        turning = np.exp(-2j * np.pi * 1000 * np.arange(len(samples)) / RATE)
        amplitudes = 2 * np.abs((samples * turning[:, None]).mean(axis=0))
        np.testing.assert_allclose(20 * np.log10(amplitudes / 0.5), 0, atol=0.1)
        amp.end()
        capture.close()


def test_devices_are_listed_with_outputs_inputs_rate_and_block() -> None:
    """Those of a dummy server of 4 outputs and 3 inputs, and why a host is missing; exit 0."""
    name = f"list{os.getpid()}"
    with jack_server(name, rate=RATE, inputs=3, outputs=4) as server:
        capture = capture_on(name, "card", CHANNELS)
        found = _listed(server.environment)["devices"]
        capture.close()
    by_name = {each["device"]: each for each in found if each["host"] == "JACK"}
    common = {"host": "JACK", "rate_hz": RATE, "block_frames": BLOCK}
    assert by_name["jack"] == common | {
        "device": "jack", "name": "hardware", "outputs": 4, "inputs": 3,
    }  # fmt: skip
    assert by_name["jack:card"] == common | {
        "device": "jack:card", "name": "card", "outputs": CHANNELS, "inputs": 0,
    }  # fmt: skip
    without = _listed(os.environ | {"JACK_DEFAULT_SERVER": f"none{os.getpid()}"})
    assert "no server is running" in without["missing"][0]["reason"]


def _listed(environment: dict[str, str]) -> dict[str, list[dict[str, object]]]:
    done = subprocess.run(
        [ERA, "soft-amp", "--list", "--json"], capture_output=True, env=environment, check=True
    )
    return json.loads(done.stdout)  # type: ignore[no-any-return]
