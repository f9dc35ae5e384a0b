"""Joint answers: choose the contents of all targets with one query of the table.

The frequency that a finger already feels is part of its content. It is kept, as is its phase at
that finger, unless another frequency serves more fingers.

Moving fingers are solved for a 16 mm stretch of their path, at three points simultaneously: each
with its own content and quiet for all others. The stretch is centered on the 8 mm between two
positions: where the change of weights to this answer is half complete, and where the change to the
next answer will be. The promise is the mean power there over sampled plates, plus an allowance for
side bands that changing weights cause in other fingers' contents (`model.answer.promise`).

Because frequencies are kept, the result depends on the order of arrival, until all fingers rest
(`controller.play.crossfades`).
"""

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from controller.play.intent import (
    MAX_DB_SL,
    FingerTarget,
    Target,
    Targets,
    band_of_table,
    contacts_of,
)
from controller.play.selected_contents import (
    Content,
    ContentKey,
    FingerSensation,
    Question,
    Selection,
    judged,
    not_served,
    reaches_threshold,
)
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import (
    HELD_BACK,
    IMPERCEPTIBLE_DB_SL,
    MIN_CONTRAST_DB,
    OWN_CONTRAST_DB,
    Answer,
    Layer,
    Sensation,
)
from model.answer.envelope import ONSET_RAMP
from model.answer.plan import answer
from model.answer.promise import with_tones
from model.answer.stimulus import ANY, BY_NAME, MUST, NEVER, Finger, Placement, Stimulus
from model.arrays import Complex64Array, FloatArray, Point
from model.finger import FINGERTIP_RADIUS
from model.structure.fingertips import MIN_LOAD
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.vibration import Excitation, Tone
from registry.limits import MAX_CONTACTS

STRETCH = 0.008
"""Distance [m] after which a moving finger gets a new answer, which covers twice that distance."""

SHORT_OF = 1.0
"""Tolerated loss of level [dB] for a kept frequency."""

LIMITS_LEAVE_NOTHING = "the limits of the amplifiers allow nothing that is felt; raise them"

NEIGHBORS_LEAVE_NOTHING = (
    "a quiet finger must stay at -10 dB SL, but at every level that reaches the target it does "
    "not; lift or move that finger away"
)

_ANSWER_TIME = 0.020  # s; from a question until its answer begins to play
_SIDE_BANDS = 2

Shape = Callable[[Placement, Layer, bool], Layer]
"""Adds the envelopes of a layer, without an onset if the last argument is true."""


def answered(
    table: LocalizationTable,
    question: Question,
    targets: Targets,
    capabilities: PlaybackCapabilities,
    *,
    keeps: bool = True,
    now: float = math.inf,
    avoided_hz: Sequence[float] = (),
) -> Answer:
    """Choose vibrations for some targets of a question; all other contacts are quiet.

    Moving fingers are solved along their paths. keeps: whether present frequencies are kept, unless
    others serve more fingers, or serve them more strongly; now [s]: infinite if all fingers rest;
    avoided_hz: frequencies that play at the same time. Raises InputError for fingers that are too
    close.
    """
    quiet = question.quiet_beside(targets)
    first_target = targets[0].target
    fingers = fingers_of(table, targets, quiet, capabilities, question.protected)
    if len(targets) > 1 or first_target.modulation_hz is not None:
        fingers = _as_layers_allow(fingers, len(targets), capabilities)
    contacts = [*contacts_of(targets), *quiet]
    fingers = with_paths(fingers, contacts, now, table.plate)
    has_onsets = capabilities.envelope_support.onset_knots > 0
    request = partial(
        answer,
        table,
        drive_mode=capabilities.drive_mode,
        shaped=has_onsets and not first_target.is_short,  # either all targets are short or none
        limits=capabilities.limits,
        avoided_hz=avoided_hz,
    )
    tuned_fingers = fingers
    if keeps:
        tuned_fingers = _tuned_as_played(fingers, targets, question.playing)
    solution = request(tuned_fingers)
    if tuned_fingers != fingers and _may_be_improved(solution, len(targets)):
        free_solution = request(fingers)
        if _serves_better(free_solution, solution):
            solution = free_solution
    return _on_paths(table, solution, len(contacts))


def _may_be_improved(solution: Answer, count: int) -> bool:
    """Whether an answer leaves out a target, or is weaker than requested."""
    return len(solution.layers) < count or _lowered_db(solution) >= SHORT_OF


def _serves_better(solution: Answer, kept: Answer) -> bool:
    """Whether an answer has more layers than the one of kept frequencies, or is clearly louder."""
    if len(solution.layers) != len(kept.layers):
        return len(solution.layers) > len(kept.layers)
    shortfall = _lowered_db(kept)
    return shortfall >= SHORT_OF and _lowered_db(solution) < shortfall


def fingers_of(
    table: LocalizationTable,
    targets: Sequence[FingerTarget],
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    protected: frozenset[ContactKey] = frozenset(),
) -> list[Finger]:
    """Return the fingers of targets, followed by the quiet fingers.

    protected: contacts that must not notice the vibrations of others. A duration is requested only
    for a single target, and for pulses that end before an onset would have settled.
    """
    fingers = list[Finger]()
    for contact, target in targets:
        band = playable_band(target.band, table.frequencies, capabilities.limits.frequencies)
        min_contrast = OWN_CONTRAST_DB if target.is_own else -math.inf
        finger = Finger(
            (contact.x, contact.y),
            _stimulus_of(target, band, is_single=len(targets) == 1),
            contact.load,
            target.priority,
            _sharing_of(target),
            min_contrast_db=min_contrast,
            max_foreign_db_sl=_max_foreign_db_sl(contact, protected),
        )
        fingers.append(finger)
    for contact in quiet:
        finger = Finger(
            (contact.x, contact.y),
            load=contact.load,
            is_protected=not contact.is_surplus,
            max_foreign_db_sl=_max_foreign_db_sl(contact, protected),
        )
        fingers.append(finger)
    return fingers


def _stimulus_of(target: Target, band: tuple[float, float], *, is_single: bool) -> Stimulus:
    """Return the stimulus of a target within a playable band [Hz]."""
    has_duration = target.course is None and (is_single or target.is_short)
    duration = None
    if has_duration and target.pulse is not None and target.pulse.is_raised:
        duration = target.pulse.duration
    modulation_hz = None
    if duration is None:
        modulation_hz = target.modulation_hz
    level = target.level_db_sl
    if level is None:
        level = MAX_DB_SL
    return Stimulus(
        level,
        band,
        duration,
        modulation_hz,
        is_limit=target.level_db_sl is None,
        name=target.content,
        course=target.course,
    )


def _sharing_of(target: Target) -> str:
    """Return which vibrations of other fingers a target can share."""
    if target.is_own or target.course is not None:  # courses begin at different times
        return NEVER
    if target.may_share:
        return ANY
    return BY_NAME


def _max_foreign_db_sl(contact: Contact, protected: frozenset[ContactKey]) -> float:
    """Return the largest level [dB SL] of foreign vibrations that a contact may feel."""
    return IMPERCEPTIBLE_DB_SL if contact.key in protected else math.inf


def playable_band(
    band: tuple[float, float] | None, frequencies: FloatArray, playable: tuple[float, float]
) -> tuple[float, float]:
    """Return the lowest and highest frequency [Hz] of a band that can be played.

    A band without a playable frequency of the table is ignored.
    """
    if band is None:
        return playable
    table_low, table_high = band_of_table(band, frequencies)
    low = max(playable[0], table_low)
    high = min(playable[1], table_high)
    is_in_band = (frequencies >= low) & (frequencies <= high)
    if not is_in_band.any():
        return playable
    return low, high


def _as_layers_allow(
    fingers: Sequence[Finger], target_count: int, capabilities: PlaybackCapabilities
) -> list[Finger]:
    """Return fingers; stimuli with low priority are steady if their side bands have no free layer.

    One layer is left free for a click.
    """
    allowed = [*fingers]
    spare_layers = capabilities.layers - target_count - 1
    by_priority = sorted(range(target_count), key=lambda number: -fingers[number].priority)
    for number in by_priority:
        stimulus = fingers[number].stimulus
        if stimulus is None or stimulus.modulation_hz is None:
            continue
        if spare_layers >= _SIDE_BANDS:
            spare_layers -= _SIDE_BANDS
        else:
            steady = replace(stimulus, modulation_hz=None)
            allowed[number] = replace(fingers[number], stimulus=steady)
    return allowed


def _tuned_as_played(
    fingers: Sequence[Finger],
    targets: Targets,
    playing: Mapping[ContentKey, Content],
) -> list[Finger]:
    """Return fingers tuned to the frequencies that they feel now, if their bands allow it."""
    tuned_fingers = [*fingers]
    for number, (contact, target) in enumerate(targets):
        content = playing.get(ContentKey(contact.key, target.voice))
        stimulus = fingers[number].stimulus
        if content is None or stimulus is None:
            continue
        frequency = content.frequency
        low, high = stimulus.band_hz
        if frequency is not None and low <= frequency <= high:
            tuned = replace(stimulus, band_hz=(frequency, frequency))
            tuned_fingers[number] = replace(fingers[number], stimulus=tuned)
    return tuned_fingers


def _lowered_db(solution: Answer) -> float:
    """Return the largest difference [dB] between a requested level and the level of the answer."""
    lowered = 0.0
    for sensation in solution.fingers:
        lowered = max(lowered, sensation.lowered_db)
    return lowered


def selection_of(
    table: LocalizationTable,
    question: Question,
    solution: Answer,
    targets: Targets,
    *,
    shape: Shape | None = None,
    is_in_phase: bool = True,
) -> Selection:
    """Return the contents of an answer to some targets of a question.

    The phases of contents that play are kept if is_in_phase; shape: adds envelopes.
    """
    quiet = question.quiet_beside(targets)
    unserved = _unserved(targets, solution)
    unserved_keys = {finger.contact.key for finger in unserved}
    positions = [finger.at for finger in solution.asked[: len(targets)]]
    phases = _Phases(table, tuple(positions))
    contents = list[Content]()
    for layer in solution.layers:
        own_targets = list[FingerTarget]()
        sensations = list[Sensation]()
        for number in layer.fingers:
            finger = targets[number]
            if finger.contact.key not in unserved_keys:
                own_targets.append(finger)
                sensations.append(_within_pulse(solution.fingers[number], finger.target))
        if not own_targets:
            continue
        owner, target = own_targets[0]
        carrier = Content(
            key=ContentKey(owner.key, target.voice),
            targets=tuple(own_targets),
            placement=solution.placement(layer),
            layer=layer,
            sensations=tuple(sensations),
        )
        contents += _voices_of(carrier, question.playing, phases, shape, is_in_phase=is_in_phase)
    reason = None
    if not contents:
        reason = unserved[0].held_back
    foreign_levels = dict[ContactKey, tuple[float, ...]]()
    contacts = [*contacts_of(targets), *quiet]
    for contact, sensation in zip(contacts, solution.fingers, strict=False):
        foreign_levels[contact.key] = sensation.foreign_levels_db_sl
    return Selection(
        targets,
        quiet,
        tuple(contents),
        reason,
        tuple(unserved),
        foreign_levels=foreign_levels,
        protected=question.protected,
    )


def _unserved(targets: Targets, solution: Answer) -> list[FingerSensation]:
    """Return the targets without a content, with the reasons."""
    unserved = list[FingerSensation]()
    for (contact, _), sensation in zip(targets, solution.fingers, strict=False):
        if sensation.verdict == HELD_BACK:
            why_held_back = _why_held_back(sensation)
            unserved.append(FingerSensation(contact, sensation, held_back=why_held_back))
            continue
        why_unfelt = _why_unfelt(sensation)
        if why_unfelt is not None:
            unserved.append(not_served(contact, why_unfelt))
    return unserved


def _within_pulse(sensation: Sensation, target: Target) -> Sensation:
    """Return the sensation of a target; a pulse no longer masks other vibrations when it ends."""
    if target.pulse is None or sensation.pauses:
        return sensation
    return judged(replace(sensation, pauses=True), is_apart=True)


def _voices_of(
    carrier: Content,
    playing: Mapping[ContentKey, Content],
    phases: "_Phases",
    shape: Shape | None,
    *,
    is_in_phase: bool,
) -> list[Content]:
    """Return a content and its side bands, each in a layer of its own.

    playing: contents that are felt now; a content that continues keeps its phase if is_in_phase;
    shape: adds envelopes.
    """
    layers = carrier.layer.voices
    felt_now = playing.get(carrier.key)
    reference = None
    if _are_played(layers, carrier.key, playing):
        reference = felt_now
    is_continued = reference is not None
    is_turned = len(layers) > 1 or (is_in_phase and felt_now is not None)
    owner = carrier.layer.fingers[0]
    voices = list[Content]()
    for number, layer in enumerate(layers):
        if is_turned:
            layer = phases.turned(layer, reference, owner)
        if shape is not None and carrier.target.course is None:
            layer = shape(carrier.placement, layer, is_continued)
        if number == 0:
            voices.append(replace(carrier, layer=layer))
        else:
            key = ContentKey(carrier.key.finger, carrier.key.voice + number)
            voices.append(replace(carrier, key=key, layer=layer, sensations=()))
    return voices


def _are_played(
    layers: Sequence[Layer], key: ContentKey, playing: Mapping[ContentKey, Content]
) -> bool:
    """Whether a finger feels the content of a key now, with the frequencies of all these layers."""
    if key not in playing:
        return False
    for voice, layer in enumerate(layers):
        content = playing.get(ContentKey(key.finger, voice))
        if content is None or content.frequency != layer.frequency:
            return False
    return True


def _why_unfelt(sensation: Sensation) -> str | None:
    """Return why a finger would not feel its own layer; None if it would."""
    stimulus = sensation.finger.stimulus
    if sensation.layer is None or stimulus is None:
        return None
    if stimulus.is_limit and sensation.level_db_sl <= 0:
        return NEIGHBORS_LEAVE_NOTHING
    if stimulus.level_db_sl >= 0 and not reaches_threshold(sensation):
        return LIMITS_LEAVE_NOTHING
    return None


def _why_held_back(sensation: Sensation) -> str:
    """Return why the model holds back the vibration of a finger."""
    if sensation.is_disturbing:
        return "a protected finger would notice it; lower its level, or lift that finger"
    contrast = sensation.promised_contrast_db
    required = max(MIN_CONTRAST_DB, sensation.finger.min_contrast_db)
    if contrast is not None and contrast >= required:
        return (
            "too many contents for this plate: with this one, another finger would have less than "
            f"its required contrast of {MIN_CONTRAST_DB:g} dB or more; lift a finger, move it "
            "away, or widen its band"
        )
    figure = ""
    if contrast is not None and math.isfinite(contrast):
        figure = f", only {contrast:.1f} dB"
    return (
        f"too many contents for this plate: with the others it would have less than {required:g} "
        f"dB of contrast{figure}; lift a finger, move it away, or widen its band"
    )


@dataclass(frozen=True)
class _Phases:
    """Phases of layers at the fingers that feel them.

    positions: of the fingers of an answer [m].
    """

    table: LocalizationTable
    positions: tuple[Point, ...]

    @cached_property
    def _fields(self) -> Complex64Array:
        """Acceleration per ERA at full stroke (f, eras, fingers); computed on first use."""
        positions = [*self.positions]
        return self.table.unit_fields(np.array(positions), contacts=positions)

    def turned(self, layer: Layer, content: Content | None, finger: int) -> Layer:
        """Return a layer turned so that its finger feels it in the phase of a content, 0 for None.

        Side bands in phase with their carrier modulate its amplitude, not its frequency, so all
        layers are turned to the phase of the former carrier.
        """
        reference: complex = 1.0
        if content is not None:
            felt_now = self._accelerations(content.layer.excitation, finger)
            if len(felt_now) == 1:
                (reference,) = felt_now.values()
        accelerations = self._accelerations(layer.excitation, finger)
        tones = dict[str, Tone]()
        for name, tone in layer.excitation.items():
            acceleration = accelerations[tone.frequency]
            change = 0.0
            if acceleration and reference:
                change = cmath.phase(reference / acceleration)
            tones[name] = replace(tone, phase=tone.phase + change)
        return replace(layer, excitation=tones)

    def _accelerations(self, excitation: Excitation, finger: int) -> dict[float, complex]:
        """Return the complex acceleration at a finger, by frequency [Hz]."""
        fields = self._fields[:, :, [finger]]
        frequencies, accelerations = self.table.driven(excitation, fields)
        at_finger = accelerations[:, 0].tolist()
        return dict(zip(frequencies.tolist(), at_finger, strict=True))


def with_paths(
    fingers: Sequence[Finger], contacts: Sequence[Contact], now: float, plate: Plate
) -> list[Finger]:
    """Return the fingers of contacts at a time [s], moving ones at the middle of their paths.

    The start and the end of each path are appended as fingers with the same stimulus, which share
    its load: weights for three points change more slowly. A finger that may share with others, is
    modulated, or comes too near another finger is only moved to the middle.
    """
    moved = [*fingers]
    ends = list[Finger]()
    for number, (finger, contact) in enumerate(zip(fingers, contacts, strict=True)):
        path = _path_of(contact, now, plate)
        if path is None:
            continue
        neighbors = [neighbor for neighbor in (*moved, *ends) if neighbor is not finger]
        if _comes_near(path, neighbors):
            continue
        start, middle, end = path
        moved[number] = replace(finger, at=middle)
        has_room = len(moved) + len(ends) + 2 <= MAX_CONTACTS
        is_long = len({start, middle, end}) == len(path)  # not at the plate's edge
        if has_room and is_long and _is_steady_and_alone(finger, neighbors):
            stimulus = _named(finger, number)
            at_end = replace(finger, load=MIN_LOAD, sharing=MUST, stimulus=stimulus)
            ends.append(replace(at_end, at=start))
            ends.append(replace(at_end, at=end))
            moved[number] = replace(at_end, at=middle, load=finger.load - 2 * MIN_LOAD)
    return [*moved, *ends]


def _path_of(contact: Contact, now: float, plate: Plate) -> tuple[Point, Point, Point] | None:
    """Return start, middle and end of the path to solve for; None if the contact rests."""
    vx, vy = contact.velocity(now)
    speed = math.hypot(vx, vy)
    if not speed:
        return None
    last_seen = contact.track[-1][0]
    answer_delay = now - last_seen + _ANSWER_TIME + ONSET_RAMP / 2
    stretch_time = STRETCH / speed

    def position_after(delay: float) -> Point:
        x = contact.x + vx * delay
        y = contact.y + vy * delay
        return _on_plate((x, y), plate)

    start = position_after(answer_delay - stretch_time / 2)
    middle = position_after(answer_delay + stretch_time / 2)
    end = position_after(answer_delay + 3 * stretch_time / 2)
    return start, middle, end


def _on_plate(position: Point, plate: Plate) -> Point:
    x, y = position
    x_on_plate = min(max(x, 0.0), plate.length)
    y_on_plate = min(max(y, 0.0), plate.width)
    return x_on_plate, y_on_plate


def _comes_near(path: Sequence[Point], neighbors: Sequence[Finger]) -> bool:
    """Whether a path comes within a fingertip's radius of another finger."""
    for point in path:
        for neighbor in neighbors:
            if math.dist(point, neighbor.at) < FINGERTIP_RADIUS:
                return True
    return False


def _named(finger: Finger, number: int) -> Stimulus | None:
    """Return the stimulus of a finger; a stimulus without a name gets a unique one."""
    if finger.stimulus is None:
        return None
    return replace(finger.stimulus, name=finger.name or f"finger {number}")


def _is_steady_and_alone(finger: Finger, neighbors: Sequence[Finger]) -> bool:
    """Whether a finger feels nothing, or a steady content that no other finger may share."""
    if finger.stimulus is None:
        return True
    if finger.stimulus.modulation_hz is not None:
        return False
    return not any(finger.may_feel_one_with(neighbor) for neighbor in neighbors)


def _on_paths(table: LocalizationTable, solution: Answer, count: int) -> Answer:
    """Return the answer for the first fingers; the others are the ends of their paths."""
    if len(solution.asked) == count:
        return solution
    positions = [finger.at for finger in solution.asked]
    paths = [[number] for number in range(count)]
    for end in range(count, len(positions)):
        distances = [math.dist(middle, positions[end]) for middle in positions[:count]]
        nearest = distances.index(min(distances))
        paths[nearest].append(end)
    if solution.layers:
        tones = solution.tones
        rows = np.array(tones.rows)
        owners = np.array(tones.owners)
        gains = np.array(tones.gains)
        solution = with_tones(table, solution, rows, tones.weights, owners, gains, paths)
    held = [vibration for vibration in solution.held if vibration[0] < count]
    return replace(
        solution,
        asked=solution.asked[:count],
        contents=solution.contents.of_first(count),
        held=tuple(held),
    )
