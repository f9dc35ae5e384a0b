"""Sets for the layers of all amplifiers: how a content starts, continues and ends in its layer.

A content starts along an onset or a ramp. Its ending follows in a set of its own, so that no touch
waits for it. A content with a course gets a set for each piece, half a piece ahead. A vibration
ends by itself on the amplifiers if the host or a touch source falls silent, so each set is valid
for a limited time, and is renewed while sources confirm the contacts.
"""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from controller.play.intent import Pulse
from controller.play.layers import CROSSFADE, MIN_LEFT, MIN_VALID_FOR, Slot
from controller.play.routing import (
    BESIDE_CLICK,
    HELD,
    PLAIN_STEP,
    Drive,
    PlateLayer,
    piece_of,
    restarted_by,
    route,
    thinned,
)
from controller.play.selected_contents import Content
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import MAX_CONTACT_TIMEOUT, ContactKey
from drivers.host.set_admission import StagedSet
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import QUANTITIES
from model.answer import answer
from model.answer.answer_report import Timing
from model.answer.envelope import FADE_RAMP
from model.rig.rig import Rig
from model.transients.base_motion import BaseEnvelope, Envelopes

LIFT_MARGIN = 0.2
"""Time [s] that a vibration is valid for after its contact is lifted, for late frames."""

_MIN_RATE = 10.0  # sets/s; with a lower limit, touches would have to wait for endings
_LEVEL = QUANTITIES["level"]

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sets:
    """The sets of all amplifiers for one moment, and the slots of all layers once they play."""

    layers: Mapping[int, PlateLayer] = field(default_factory=dict)
    """Layers that change, by number."""
    slots: Mapping[int, Slot] = field(default_factory=dict)
    """Slots of all layers, if contents start or end."""
    started: frozenset[int] = frozenset()
    """Changing layers that start another content."""
    updates: Mapping[int, answer.Layer] = field(default_factory=dict)
    """Changing layers that get an ending, the next piece of a course, or a fall."""
    silence: float | None = None
    """Ramp [s] along which all layers fall silent instead."""
    settled_after: float = 0.0
    """Time [s] until the last ramp or onset has ended."""
    skipped: Sequence[Content] = ()
    """Contents that a ledger does not admit."""
    reason: str = ""
    """Why the ledger does not admit them."""
    retry_at: float = math.inf
    """When [s] the ledger may admit them."""
    preempted_until: float = math.inf
    """When [s] an event no longer preempts endings and pieces of courses."""

    @cached_property
    def by_amplifier(self) -> dict[str, StagedSet]:
        """The set of each amplifier, by name."""
        layers_by_amplifier: dict[str, list[AmplifierLayer]] = {}
        for plate_layer in self.layers.values():
            for name, layer in plate_layer.items():
                layers_by_amplifier.setdefault(name, []).append(layer)
        return {name: StagedSet(layers) for name, layers in layers_by_amplifier.items()}

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to send."""
        return not self.layers and self.silence is None


class SetBuilder:
    """Builds the sets of a single layer for all amplifiers of a rig; it keeps no state.

    Each method returns the layer by amplifier, and the model's layer as it then plays. timing:
    shapes patterns; expiry_of: returns when [s] a contact is lifted unless a frame arrives.
    """

    def __init__(
        self,
        rig: Rig,
        capabilities: PlaybackCapabilities,
        timing: Timing,
        expiry_of: Callable[[ContactKey], float],
    ) -> None:
        self._rig = rig
        self._timing = timing
        self._expiry_of = expiry_of
        self._ramp_max = capabilities.ramp_max
        self._support = capabilities.envelope_support
        has_endings = self._support.ending_knots > 0
        self._sends_endings = has_endings and rig.limits.rate >= _MIN_RATE
        self._course_knots = capabilities.course_knots  # of a piece; 0 for ramps
        cause = "without envelopes"
        if not math.isinf(rig.limits.slew):  # which lengthens ramps
            self._course_knots = 0
            cause = "with a limit of slew"
        if not self._course_knots:
            _logger.debug("loop: files follow in ramps of %g s, %s", PLAIN_STEP, cause)

    def start(
        self,
        number: int,
        content: Content,
        now: float,
        *,
        former: Slot | None,
        fade: float,
        among: int,
        is_shaped: bool,
    ) -> tuple[PlateLayer, Slot]:
        """Return the set that starts a content in a layer, and its slot.

        former: the slot of the layer until now; fade [s]: in which the content replaces another, 0
        from silence; among: number of layers that start simultaneously, which share the time on the
        wires; is_shaped: whether envelopes are allowed.
        """
        if content.course is not None:
            plate_layer, layer = self.piece(
                number, content, now, former=former, among=among, is_first=True
            )
            return plate_layer, Slot(content, layer)
        has_envelopes = is_shaped and not content.target.is_short
        playing: Drive = {} if former is None else former.tones
        restarted = restarted_by(content.layer.excitation, playing)
        onset = None
        if has_envelopes:
            frequencies = [tone.frequency for tone in content.layer.excitation.values()]
            is_continued = fade > 0 or not restarted.issuperset(frequencies)
            onset = self._onset(content, among=among, is_continued=is_continued)
        plate_layer = route(
            content.layer.excitation,
            self._rig,
            ramp=min(fade or content.layer.ramp, self._ramp_max),
            number=number,
            playing=playing,
            restarted=restarted,
            valid_for=self._valid_for(content, now),
            onset=onset,
        )
        layer = _as_played(content.layer, plate_layer, onset)
        return plate_layer, Slot(content, layer, has_envelopes and self._sends_endings)

    def _onset(self, content: Content, *, among: int, is_continued: bool) -> Envelopes | None:
        """Return the onset of a content by ERA; None for a ramp.

        A tone that continues or cross-fades needs no onset, even if an ERA joins it.
        """
        shaped = self._support.shape(
            self._timing, content.placement, content.layer, is_continued, adds_ending=False
        )
        if not shaped.onset:
            return None
        knots = max(1, self._support.onset_knots // among)
        return thinned(shaped.onset, knots=knots)

    def ending(self, number: int, slot: Slot, now: float) -> tuple[PlateLayer, answer.Layer]:
        """Return the set that adds an ending to a pattern that continues, and that pattern."""
        content = slot.content
        layer = replace(content.layer, ramp=slot.layer.ramp)
        layer = self._support.shape(self._timing, content.placement, layer, is_continued=True)
        plate_layer = route(
            layer.excitation,
            self._rig,
            ramp=layer.ramp,
            number=number,
            playing=slot.tones,
            restarted=frozenset(),
            valid_for=self._valid_for(content, now),
            ending=layer.ending,
        )
        return plate_layer, layer

    def fall(self, number: int, slot: Slot) -> tuple[PlateLayer, answer.Layer]:
        """Return the set that lets a layer fall below any threshold and end, and its layer.

        It does not fall to silence, since no later set could end that sooner, for instance when its
        finger lifts.
        """
        lowest_level = _LEVEL.from_wire(1)
        ramp = min(CROSSFADE, self._ramp_max)
        full_levels = self._rig.full_levels
        faint = {
            name: replace(tone, amplitude=lowest_level * full_levels[name])
            for name, tone in slot.layer.excitation.items()
        }
        plate_layer = route(
            faint,
            self._rig,
            ramp=ramp,
            number=number,
            playing=slot.tones,
            restarted=frozenset(),
            valid_for=ramp,
        )
        return plate_layer, slot.layer

    def piece(
        self,
        number: int,
        content: Content,
        now: float,
        *,
        former: Slot | None,
        among: int,
        is_first: bool,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Return the set of the next piece of a content's course in a layer, and the piece.

        The piece starts at the pulse's position in the course at a time [s], or when the previous
        piece ends if that still plays, and from the present tones. former: the slot of the layer
        until now; among: number of pieces that are sent together; is_first: whether the former
        slot has played no piece of this course.
        """
        if content.course is None:
            raise ValueError("content must have a course")
        course, pulse = content.course
        playing: Drive = {} if former is None else former.tones
        starts_at = now
        if former is not None and not is_first:
            starts_at = max(now, former.piece_until)
            if now >= former.ends_at:
                playing = {}
        elapsed = 0.0
        if pulse.started_at is not None:
            elapsed = starts_at - pulse.started_at
        knots = self._knots_of_piece(is_first=is_first, among=among)
        step, shares = piece_of(course, pulse, elapsed, knots=knots, is_first=is_first)
        onset = _course_onset(content.layer, shares, step)
        last_tones = {
            name: replace(tone, amplitude=shares[-1] * tone.amplitude)
            for name, tone in content.layer.excitation.items()
        }
        ramp = FADE_RAMP if onset else step
        plate_layer = route(
            last_tones,
            self._rig,
            ramp=min(ramp, self._ramp_max),
            number=number,
            playing=playing,
            restarted=frozenset(),
            valid_for=step * len(shares) + HELD,
            onset=onset,
        )
        layer = _as_played(content.layer, plate_layer, onset)
        if starts_at > now and onset is not None:
            plate_layer = {
                name: replace(amplifier_layer, after=True)
                for name, amplifier_layer in plate_layer.items()
            }
        return plate_layer, layer

    def _knots_of_piece(self, *, is_first: bool, among: int) -> int:
        """Return the number of knots of a piece that is sent among others; 0 for a ramp."""
        knots = self._course_knots
        if is_first:
            knots = min(knots, self._support.onset_knots)
        if not knots:
            return 0
        return max(knots // among, 1)

    def renewal(self, number: int, slot: Slot, now: float) -> PlateLayer | None:
        """Return the set that prolongs a content; None unless its contacts were confirmed again."""
        if now >= slot.ends_at - LIFT_MARGIN / 2:
            return None
        if self.confirmed_until(slot.content) <= slot.confirmed_until:
            return None
        valid_for = self._valid_for(slot.content, now)
        layer = AmplifierLayer(number, ramp=slot.layer.ramp, valid_for=valid_for, renew=True)
        return dict.fromkeys(self._rig.amplifiers, layer)

    def end(self, number: int, slot: Slot | None, now: float, *, ramp: float) -> PlateLayer:
        """Return the set that ends a layer: along its ending if it has one, else along a ramp.

        slot: None for a ramp.
        """
        if slot is not None and slot.can_end_shaped(now):
            end = AmplifierLayer(number, ramp=ramp)
            return dict.fromkeys(self._rig.amplifiers, end)
        return route({}, self._rig, ramp=ramp, number=number)

    def end_ramp(self, contents: Iterable[Content]) -> float:
        """Return the ramp [s] along which layers end while these contents play."""
        has_click = any(content.target.is_short for content in contents)
        ramp = BESIDE_CLICK if has_click else FADE_RAMP
        return min(ramp, self._ramp_max)

    def confirmed_until(self, content: Content) -> float:
        """Return when [s] the first target of a content is lifted unless a frame arrives."""
        return min([self._expiry_of(finger.contact.key) for finger in content.targets])

    def _valid_for(self, content: Content, now: float) -> float:
        """Return how long [s] a content can last from a time [s] on without a renewal.

        The amplifiers end the content with its last pulse.
        """
        unconfirmed_in = self.confirmed_until(content) - now + LIFT_MARGIN
        without_pulse = min(max(unconfirmed_in, MIN_VALID_FOR), MAX_CONTACT_TIMEOUT)
        pulse_times = [_remaining(finger.target.pulse, now) for finger in content.targets]
        return min(without_pulse, max(pulse_times))


def _as_played(
    layer: answer.Layer,
    plate_layer: PlateLayer,
    onset: Envelopes | None,
) -> answer.Layer:
    """Return a layer with the onset and the ramp of its set, and without an ending."""
    ramp = next(iter(plate_layer.values())).ramp
    return replace(layer, ramp=ramp, onset=onset, ending=None)


def _course_onset(
    layer: answer.Layer, shares: Sequence[float], step: float
) -> dict[str, BaseEnvelope] | None:
    """Return the onset of a piece by ERA, whose shares are a step [s] apart; None for a ramp."""
    if len(shares) < 2:
        return None
    onset = dict[str, BaseEnvelope]()
    for name, tone in layer.excitation.items():
        motions = tuple([share * tone.phasor for share in shares])
        onset[name] = BaseEnvelope(tone.frequency, 0.0, motions, step)
    return onset or None


def _remaining(pulse: Pulse | None, now: float) -> float:
    """Return how long [s] a target is driven after a time [s]; infinite without a pulse."""
    if pulse is None:
        return math.inf
    if pulse.started_at is None:
        return pulse.duration
    return max(pulse.end - now, MIN_LEFT)
