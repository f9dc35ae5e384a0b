"""Parts of a far end: terminals, delays of lines, programs of the firmware.

Delays are by the numbers of their standards and data sheets.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from model.errors import InputError
from sim.far_ends import firmware
from sim.transport.simulated_line import LINE_KINDS
from sim.transport.terminal_links import linked_urls, links_by_amplifier


@pytest.mark.parametrize("name", LINE_KINDS)
def test_delays_keep_the_order_and_are_those_of_their_seed(name: str) -> None:
    """Bytes leave in order in each direction and in time; another seed has other delays."""

    def drawn(seed: object) -> list[float]:
        delays = LINE_KINDS[name].delays(seed)
        return [delays.leave(n * 1e-4, 30) for n in range(300)] + [
            delays.arrive(n * 1e-4, 30) for n in range(300)
        ]

    times = drawn(("line", 1))
    spent = [time - n % 300 * 1e-4 for n, time in enumerate(times)]
    assert max(spent[:300]) + max(spent[300:]) <= LINE_KINDS[name].max_delay + 1e-3
    assert times[:300] == sorted(times[:300])
    assert times[300:] == sorted(times[300:])
    assert times == drawn(("line", 1)) != drawn(("line", 2))


@pytest.fixture
def terminal() -> Iterator[str]:
    """The path of a pseudo-terminal."""
    near, far = os.openpty()
    yield os.ttyname(far)
    os.close(near)
    os.close(far)


def test_amplifiers_of_one_line_share_its_link(tmp_path: Path, terminal: str) -> None:
    """The rest of each URL stays; the link leads to the terminal, and goes at the end."""
    link = tmp_path / "line"
    urls = {
        "a": f"serial://{terminal}?address=1",
        "b": f"serial://{terminal}?address=2",
        "c": "modbus+tcp://127.0.0.1:502/1",
    }
    with linked_urls(urls, links_by_amplifier([str(link)], amplifiers=list(urls))) as moved:
        assert moved == {
            "a": f"serial://{link}?address=1",
            "b": f"serial://{link}?address=2",
            "c": "modbus+tcp://127.0.0.1:502/1",
        }
        assert str(link.readlink()) == terminal
    assert not link.is_symlink()


@pytest.mark.parametrize("options", [["d=/tmp/x"], ["a="], ["a=/tmp/x", "/tmp/y"]])
def test_options_that_name_no_line_are_refused(options: list[str]) -> None:
    """An unknown amplifier, no path, and two paths for one amplifier."""
    with pytest.raises(InputError, match="--link"):
        links_by_amplifier(options, amplifiers=["a", "b"])


@pytest.mark.parametrize("is_emulated", [False, True])
def test_missing_firmware_is_told_with_the_remedy(
    is_emulated: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a checkout the command that builds it, elsewhere that a checkout is needed."""
    monkeypatch.setattr(firmware, "FIRMWARE_FOLDER", tmp_path / "out" / "firmware")
    monkeypatch.setattr(firmware, "EMULATOR", "sh")
    with pytest.raises(InputError, match="checkout"):
        firmware.find_firmware(is_emulated=is_emulated)
    (tmp_path / "firmware").mkdir()
    with pytest.raises(InputError, match="make firmware"):
        firmware.find_firmware(is_emulated=is_emulated)


def test_missing_emulator_is_told_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without QEMU, the command that installs it."""
    monkeypatch.setattr(firmware, "EMULATOR", "emulator-of-nobody")
    with pytest.raises(InputError, match="apt install emulator-of-nobody"):
        firmware.find_firmware(is_emulated=True)
