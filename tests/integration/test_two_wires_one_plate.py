"""Amplifiers on different wires over one plate, against one amplifier with all the channels."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from drivers.host.group import Group
from drivers.opening import Lines
from far_end_process import FarEndProcess, far_end_process
from model.calibration.sensed_plate import sensed_plate
from model.rig.file import load_rig
from patient_daemon import wait_long
from registry.limits import GuardLimits
from rig_files import TWO_AMPLIFIERS, write_rig
from sim.plant.imperfections import draw_imperfections
from words_bench import layer

FREQUENCY = 170.0
# What no quantisation step divides, so that rounding shows.
DRIVE = {"SW": (0.123456, 12.3456), "SE": (0.2, -60.0), "NE": (0.3333, 101.0), "NW": (0.05, 179.99)}
SENSORS = {"P1": [0.03, 0.05], "P2": [0.2, 0.11], "P3": [0.29, 0.2]}


async def steady(far_end: FarEndProcess, wiring: Mapping[str, tuple[str, int]]) -> np.ndarray:
    """Complex amplitudes at the sensors once all ERAs have played for two seconds."""
    sensors = {name: {"at_m": at} for name, at in SENSORS.items()}
    assert "error" not in await far_end.ask("sensors", sensors=sensors)
    lines, limits = Lines(), GuardLimits(40, 500, 1)
    try:
        group = Group(
            {
                name: await lines.amplifier(url, limits, name=name)
                for name, url in far_end.urls.items()
            },
            watchdog=2.0,
        )
        await group.open()
        await group.arm()
        tones = {
            name: [
                (number, FREQUENCY, *DRIVE[era])
                for era, (at, number) in wiring.items()
                if at == name
            ]
            for name in group.amplifiers
        }
        await group.apply({name: [layer(*each, ramp=0.0)] for name, each in tones.items()})
        begin = (await far_end.ask("state"))["time_s"]
        for _ in range(2):
            await far_end.ask("step", seconds=1.25)
            for amplifier in group.amplifiers.values():
                await amplifier.ping()  # of a watchdog in virtual time
        heard = await far_end.ask(
            "tones", since_s=begin + 2, until_s=begin + 2.5, frequencies_hz=[FREQUENCY]
        )
    finally:
        await lines.close()
    turn = np.exp(2j * np.pi * FREQUENCY * begin)
    return np.array(
        [
            (sensor["real_m_s2"][0] + 1j * sensor["imag_m_s2"][0]) * turn
            for sensor in heard["sensors"].values()
        ]
    )


def predicted(file: Path) -> np.ndarray:
    """Steady accelerations (s,) [m/s²] by the model, of the plate and channels that are drawn."""
    rig = load_rig(file)
    drawn = draw_imperfections(rig)
    real = drawn.plate.realised(rig)
    points = np.array(list(SENSORS.values()))
    responses = sensed_plate(real, points, np.array([FREQUENCY])).responses()[0]
    bases = []
    for era in rig.eras:
        level, degrees = DRIVE[era.name]
        errors = drawn.channels[rig.wiring[era.name]]
        turn = np.exp(1j * (np.radians(degrees) + errors.phase))
        bases.append(level * errors.gain * era.stroke * turn)
    return np.asarray(bases @ responses)


@pytest.mark.parametrize(
    ("main", "side"), [("serial", "modbus-tcp"), ("slcan", "modbus-rtu"), ("socketcand", "serial")]
)
async def test_two_wires_move_the_plate_as_one_does(
    tmp_path: Path, main: str, side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same ERAs, same drive: whichever wires carry it, the plate answers the same.

    Time is virtual, so that all commits are at one moment; what is left is what the wires round:
    levels to 0.01 %, phases to 0.01 degrees, together 3e-4 of what four ERAs can add up to.
    """
    wait_long(monkeypatch)
    one = write_rig(tmp_path / "one.yaml")
    two = write_rig(tmp_path / "two.yaml", *TWO_AMPLIFIERS)
    options = ("--virtual-time", "--wire", f"main={main}")
    async with far_end_process(one, *options) as far_end:
        alone = await steady(far_end, {era: ("main", n) for n, era in enumerate(DRIVE)})
    async with far_end_process(two, *options, "--wire", f"side={side}", amplifiers=2) as far_end:
        assert [url.partition(":")[0] for url in far_end.urls.values()] == [
            SCHEMES[main],
            SCHEMES[side],
        ]
        shared = await steady(
            far_end, {"SW": ("main", 0), "SE": ("main", 1), "NE": ("side", 0), "NW": ("side", 1)}
        )
    assert np.abs(alone).min() > 1
    # The model in the frequency domain; structural damping is viscous in time, half a percent.
    np.testing.assert_allclose(alone, predicted(one), rtol=0, atol=0.01 * np.abs(alone).max())
    np.testing.assert_allclose(shared, alone, rtol=0, atol=3e-4 * np.abs(alone).max())


SCHEMES = {
    "serial": "serial",
    "modbus-tcp": "modbus+tcp",
    "modbus-rtu": "modbus+rtu",
    "slcan": "can+slcan",
    "socketcand": "can+socketcand",
}
