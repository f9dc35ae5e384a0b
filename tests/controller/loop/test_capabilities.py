"""Capabilities of the open amplifiers, and envelopes that their wires load in time."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest

from controller.loop.capabilities import playback_capabilities
from controller.loop.envelopes import (
    EnvelopeSupport,
    ending_slots,
    envelope_support,
    onset_slots,
    wire_envelopes,
)
from drivers.command import Envelope as WireEnvelope
from drivers.command import Knot
from drivers.protocol.messages import Capabilities, Feature
from drivers.protocol.wire_times import WireTimes
from model.errors import InputError
from model.fem.mesh import Mesh
from model.rig.rig import Channel, Rig
from model.structure.actuator import Era
from model.structure.material import Material
from model.structure.plate import Plate
from model.table.pattern import Pattern
from model.transients.envelope import BaseEnvelope
from model.vibration.excitation import Tone
from registry.limits import GuardLimits
from sim.amplifier.amplifier import capabilities
from stub_wire_times import StubWireTimes

FINE = capabilities(4)
BOTH, ONSETS, ENDINGS = (
    EnvelopeSupport(True, True),
    EnvelopeSupport(True, False),
    EnvelopeSupport(False, True),
)


@dataclass
class Opened:
    """An amplifier that takes a time [s] for each knot."""

    capabilities: Capabilities = FINE
    bus: str | None = None
    knot_time: float = 0.0

    @property
    def wire_times(self) -> WireTimes:
        """In proportion to the knots."""
        return StubWireTimes(knot_takes=self.knot_time)


def rig() -> Rig:
    """Two ERAs on the left amplifier, one on the right."""
    return Rig(
        plate=Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33)),
        mesh=Mesh(4, 4, 0.3, 0.2),
        eras=tuple(
            Era(name, x, 0.0, 17_000.0, 1.0, 0.0, stroke)
            for name, x, stroke in (("A", 0.0, 1e-4), ("B", 0.15, 2e-4), ("C", 0.3, 1e-4))
        ),
        wiring={"A": Channel("left", 3), "C": Channel("right", 0), "B": Channel("left", 1)},
        amplifiers={"left": "fake://", "right": "fake://"},
        limits=GuardLimits(40.0, 500.0, 0.8),
    )


@pytest.mark.parametrize(
    ("steps", "mode"),
    [
        ([(1e-4, 0.01), (1e-4, 0.01)], "phased"),
        ([(1e-4, 0.01), (1e-4, 180.0)], "signed"),
        ([(1e-4, 360.0), (1e-4, 0.01)], "graded"),
        ([(1e-4, 0.01), (1.0, 0.01)], "switched"),
    ],
)
def test_capabilities_choose_the_best_common_drive_mode(
    steps: list[tuple[float, float]], mode: str
) -> None:
    """By the steps of level and phase [degrees] of each amplifier."""
    left, right = (
        Opened(replace(FINE, level_step=level, phase_step=phase)) for level, phase in steps
    )
    capabilities = playback_capabilities(rig(), {"left": left, "right": right})
    assert capabilities.drive_mode == mode
    assert capabilities.playable[-1] == mode


@pytest.mark.parametrize(
    ("left", "right", "is_coherent"),
    [
        (Feature(0), Feature(0), True),
        (Feature.PHASE, Feature(0), False),
        (Feature(0), Feature.STAGING, False),
        (Feature.VALID_FOR | Feature.WATCHDOG | Feature.BROADCAST, Feature(0), True),
    ],
)
def test_capabilities_need_phases_and_a_common_start(
    left: Feature, right: Feature, is_coherent: bool
) -> None:
    """Else one ERA plays at a time; of what each amplifier lacks."""
    each = {
        name: Opened(replace(FINE, features=FINE.features & ~lacking))
        for name, lacking in (("left", left), ("right", right))
    }
    capabilities = playback_capabilities(rig(), each)
    assert (capabilities.playable == ("switched",)) is not is_coherent
    assert capabilities.eras_at_most == (2 if is_coherent else 1)


def test_capabilities_refuse_an_unplayable_drive_mode() -> None:
    """With those that can be played."""
    plain = {name: Opened(replace(FINE, phase_step=360.0)) for name in ("left", "right")}
    assert playback_capabilities(rig(), plain, drive_mode="switched").drive_mode == "switched"
    with pytest.raises(InputError, match=r"switched, graded.*phased"):
        playback_capabilities(rig(), plain, drive_mode="phased")


def test_capabilities_are_the_tightest_limits() -> None:
    """Of the rig and all amplifiers."""
    left = Opened(replace(FINE, frequency_min=50.0, level_max=0.5))
    right = Opened(replace(FINE, frequency_max=300.0))
    capabilities = playback_capabilities(rig(), {"left": left, "right": right})
    assert capabilities.frequencies == (50.0, 300.0)
    assert capabilities.max_amplitudes == pytest.approx({"A": 5e-5, "B": 1e-4, "C": 8e-5})


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        (Opened(), Opened(), BOTH),
        # An onset has 20 knots on the wire, an ending 7; the left amplifier has two of each.
        (Opened(knot_time=0.015 / 40), Opened(), BOTH),
        (Opened(knot_time=0.0151 / 40), Opened(), ENDINGS),
        (Opened(knot_time=0.0191 / 14), Opened(), EnvelopeSupport(False, False)),
        # Two amplifiers on one wire wait for each other, on two they do not.
        (Opened(knot_time=0.35e-3), Opened(knot_time=0.35e-3), BOTH),
        (Opened(FINE, "bus", 0.35e-3), Opened(FINE, "bus", 0.35e-3), ENDINGS),
        (Opened(replace(FINE, envelope_knots=19)), Opened(), ENDINGS),
        (Opened(), Opened(replace(FINE, envelope_knots=6)), EnvelopeSupport(False, False)),
        (Opened(replace(FINE, envelope_slots=3)), Opened(), ONSETS),
        (Opened(replace(FINE, envelope_slots=1)), Opened(), EnvelopeSupport(False, False)),
        (Opened(replace(FINE, envelope_step_min=0.01)), Opened(), EnvelopeSupport(False, False)),
    ],
)
def test_envelope_support_needs_capability_and_loading_time(
    left: Opened, right: Opened, expected: EnvelopeSupport
) -> None:
    """Knots, slots and steps of every amplifier, and 20 ms for every wire.

    Of these 0.5 ms for each exchange, and 4 ms for shaping an onset.
    """
    assert (
        envelope_support(rig(), {"left": left, "right": right}, max_loading_time=0.020) == expected
    )


def test_envelope_support_is_empty_without_loading_time() -> None:
    """However fast the wire is."""
    assert not envelope_support(rig(), {"left": Opened(), "right": Opened()}, max_loading_time=0.0)


def test_wire_envelopes_by_hand() -> None:
    """Levels in strokes, phases in degrees, without the last knot; a slot each, onsets first."""
    pattern = Pattern(
        {"A": Tone(110.0, 5e-5)},
        0.02,
        20.0,
        None,
        None,
        onset={
            "B": BaseEnvelope(110.0, 0, (1e-4j, -2e-4, 0)),
            "A": BaseEnvelope(110.0, 0, (2e-5, 5e-5)),
        },
        ending={"A": BaseEnvelope(110.0, 5e-5, (-1e-5j, 0))},
    )
    assert onset_slots(rig()) == {"A": 1, "B": 2, "C": 1}
    assert ending_slots(rig()) == {"A": 3, "B": 4, "C": 2}
    loads = wire_envelopes(pattern, rig())
    assert loads["right"] == ()
    close: Callable[[float], Any] = pytest.approx
    assert loads["left"] == (
        WireEnvelope(2, 0.005, (Knot(close(0.5), close(90.0)), Knot(close(1.0), close(180.0)))),
        WireEnvelope(1, 0.005, (Knot(close(0.2), 0.0),)),
        WireEnvelope(3, 0.005, (Knot(close(0.1), close(-90.0)),)),
    )


def test_wire_envelopes_round_full_stroke_to_one() -> None:
    """A rounding error above it would be refused by the guard."""
    full = complex(1e-4 * math.cos(1.0), 1e-4 * math.sin(1.0)) * (1 + 1e-12)
    pattern = Pattern({}, 0.02, 20.0, None, None, onset={"A": BaseEnvelope(110.0, 0, (full, 0))})
    ((envelope,), _) = wire_envelopes(pattern, rig()).values()
    assert envelope.knots[0].level == 1.0
