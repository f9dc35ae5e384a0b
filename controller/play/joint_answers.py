"""Joint answers: choose the contents of all targets with one query of the table, and improve them.

The frequency that a finger already feels is part of its content. It is kept, as is its phase at
that finger, unless another frequency serves more fingers.

Moving fingers are solved for a 16 mm stretch of their path, at three points simultaneously: each
with its own content and quiet for all others. The stretch is centred on the 8 mm between two
positions: where the change of weights to this answer is half complete, and where the change to the
next answer will be. The promise is the mean power there over sampled plates, plus an allowance for
side bands that changing weights cause in other fingers' contents (`model.answer.promise`).

Because frequencies are kept, the result depends on the order of arrival. Once all fingers rest,
playback cross-fades (`Crossfades`) to the answer without kept frequencies. One content changes at a
time, so that other fingers feel little of the change. If only weights change, for instance after a
finger has left, the layer itself follows the same ramp. Every step keeps all sounding frequencies,
including the outgoing one, 30 Hz apart; if no order of steps can, playback does not change. Between
steps the promise is computed for the contents that play at the time.
"""

import cmath
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from controller.play.intent import (
    MAX_DB_SL,
    Content,
    ContentKey,
    FingerSensation,
    FingerTarget,
    Question,
    Selection,
    Target,
    Targets,
    band_of_table,
    judged,
    not_served,
    own_level_db_sl,
)
from controller.play.routing import PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import (
    APART_HZ,
    HELD_BACK,
    IMPERCEPTIBLE_DB_SL,
    MIN_CONTRAST_DB,
    OWN_CONTRAST_DB,
    SAME_LEVEL,
    Answer,
    Layer,
    Sensation,
)
from model.answer.plan import answer, worst_of
from model.answer.promise import with_tones
from model.answer.stimulus import ANY, BY_NAME, MUST, NEVER, ONSET_RAMP, Finger, Placement, Stimulus
from model.arrays import NEARLY, Complex64Array, FloatArray, Point
from model.drive_modes import UNRESTRICTED
from model.finger import FINGERTIP_RADIUS
from model.structure.attachments import MIN_LOAD
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.vibration import Excitation, base_amplitudes
from registry.limits import MAX_CONTACTS

STRETCH = 0.008
"""Distance [m] after which a moving finger gets a new answer, which covers twice that distance."""

WORTH = 2.0
"""Gain in promised contrast [dB] of the worst finger that justifies other frequencies."""

WORTH_OF_WEIGHTS = 0.5
"""Gain in promised contrast [dB] of the worst finger that justifies other weights alone."""

LIMITS_LEAVE_NOTHING = "the limits of the amplifiers allow nothing that is felt; raise them"

NEIGHBOURS_LEAVE_NOTHING = (
    "a quiet finger must stay at -10 dB SL, but at every level that reaches the target it does "
    "not; lift or move that finger away"
)

_ANSWER_TIME = 0.020  # s; from a question until its answer begins to play
_SHORT_OF = 1.0  # dB; tolerated loss of level for a kept frequency
_SIDE_BANDS = 2
_SAME = 0.01  # difference between two drives that is not felt, relative to the largest amplitude

Shape = Callable[[Placement, Layer, bool], Layer]
"""Adds the envelopes of a layer, without an onset if the last argument is true."""

_Voices = Mapping[ContactKey, tuple[Content, ...]]
"""A content and its side bands, by the finger that owns it."""


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
    contacts = [*[finger.contact for finger in targets], *quiet]
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
    tuned_fingers = _tuned_as_played(fingers, targets, question.playing) if keeps else fingers
    solution = request(tuned_fingers)
    if tuned_fingers != fingers and _may_be_improved(solution, len(targets)):
        free_solution = request(fingers)
        if _serves_better(free_solution, solution):
            solution = free_solution
    return _on_paths(table, solution, len(contacts))


def _may_be_improved(solution: Answer, count: int) -> bool:
    """Whether an answer leaves out a target, or is weaker than requested."""
    return len(solution.layers) < count or _lowered_db(solution) >= _SHORT_OF


def _serves_better(solution: Answer, kept: Answer) -> bool:
    """Whether an answer has more layers than the one of kept frequencies, or is clearly louder."""
    if len(solution.layers) != len(kept.layers):
        return len(solution.layers) > len(kept.layers)
    shortfall = _lowered_db(kept)
    return shortfall >= _SHORT_OF and _lowered_db(solution) < shortfall


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
        finger = Finger(
            (contact.x, contact.y),
            _stimulus_of(target, band, is_single=len(targets) == 1),
            contact.load,
            target.priority,
            _sharing_of(target),
            min_contrast_db=OWN_CONTRAST_DB if target.is_own else -math.inf,
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
    is_limit = target.level_db_sl is None
    return Stimulus(
        MAX_DB_SL if target.level_db_sl is None else target.level_db_sl,
        band,
        duration,
        target.modulation_hz if duration is None else None,
        is_limit=is_limit,
        name=target.content,
        course=target.course,
    )


def _sharing_of(target: Target) -> str:
    """Return which vibrations of other fingers a target can share."""
    if target.is_own or target.course is not None:  # courses begin at different times
        return NEVER
    return ANY if target.may_share else BY_NAME


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
    return (low, high) if is_in_band.any() else playable


def _as_layers_allow(
    fingers: Sequence[Finger], target_count: int, capabilities: PlaybackCapabilities
) -> list[Finger]:
    """Return fingers, of which those with low priority are steady if side bands have no layer left.

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
    return max([sensation.lowered_db for sensation in solution.fingers], default=0.0)


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
    phases = _Phases(table, tuple([finger.at for finger in solution.asked[: len(targets)]]))
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
        first_contact, first_target = own_targets[0]
        carrier = Content(
            key=ContentKey(first_contact.key, first_target.voice),
            targets=tuple(own_targets),
            placement=solution.placement(layer),
            layer=layer,
            sensations=tuple(sensations),
        )
        contents += _voices_of(carrier, question.playing, phases, shape, is_in_phase=is_in_phase)
    contacts = [*[finger.contact for finger in targets], *quiet]
    return Selection(
        targets,
        quiet,
        tuple(contents),
        None if contents else unserved[0].held_back,
        tuple(unserved),
        foreign_levels=_foreign_levels(solution, contacts),
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
    contact_key, first_voice = carrier.key
    felt_now = playing.get(carrier.key)
    is_continued = felt_now is not None and _are_played(layers, contact_key, playing)
    is_turned = len(layers) > 1 or (is_in_phase and felt_now is not None)
    reference = felt_now if is_continued else None
    owner = carrier.layer.fingers[0]
    voices = list[Content]()
    for voice, layer in enumerate(layers):
        if is_turned:
            layer = phases.turned(layer, reference, owner)
        if shape is not None and carrier.target.course is None:
            layer = shape(carrier.placement, layer, is_continued)
        key = ContentKey(contact_key, first_voice + voice)
        sensations = () if voice else carrier.sensations
        voices.append(replace(carrier, key=key, layer=layer, sensations=sensations))
    return voices


def _are_played(
    layers: Sequence[Layer], key: ContactKey, playing: Mapping[ContentKey, Content]
) -> bool:
    """Whether a finger feels the frequencies of all these layers now."""
    for voice, layer in enumerate(layers):
        content = playing.get(ContentKey(key, voice))
        if content is None or content.frequency != layer.frequency:
            return False
    return True


def _foreign_levels(
    solution: Answer, contacts: Sequence[Contact]
) -> dict[ContactKey, Sequence[float]]:
    """Return the levels [dB SL] of other contents at contacts, by threshold set."""
    levels = np.array(solution.tones.foreign_db_sl)
    levels[np.isnan(levels)] = -math.inf  # at fingers that are neither targets nor quiet
    keys = [contact.key for contact in contacts]
    return dict(zip(keys, levels.tolist(), strict=False))


def _why_unfelt(sensation: Sensation) -> str | None:
    """Return why a finger would not feel its own layer; None if it would."""
    stimulus = sensation.finger.stimulus
    if sensation.layer is None or stimulus is None:
        return None
    if stimulus.is_limit and sensation.level_db_sl <= 0:
        return NEIGHBOURS_LEAVE_NOTHING
    if own_level_db_sl(sensation) < 0 <= stimulus.level_db_sl:
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
            accelerations = self._accelerations(content.layer.excitation, finger)
            if len(accelerations) == 1:
                (reference,) = accelerations.values()
        accelerations = self._accelerations(layer.excitation, finger)
        tones = {}
        for name, tone in layer.excitation.items():
            acceleration = accelerations[tone.frequency]
            change = 0.0
            if acceleration and reference:
                change = cmath.phase(reference / acceleration)
            tones[name] = replace(tone, phase=tone.phase + change)
        return replace(layer, excitation=tones)

    def _accelerations(self, excitation: Excitation, finger: int) -> dict[float, complex]:
        """Return the complex acceleration at a finger, by frequency [Hz]."""
        frequencies, accelerations = self.table.driven(excitation, self._fields[:, :, [finger]])
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
        start, middle, end = path
        others = [other for other in (*moved, *ends) if other is not finger]
        if _comes_near(path, others):
            continue
        moved[number] = replace(finger, at=middle)
        has_room = len(moved) + len(ends) + 2 <= MAX_CONTACTS
        if has_room and len(set(path)) == len(path) and _is_steady_and_alone(finger, others):
            at_end = replace(finger, load=MIN_LOAD, sharing=MUST, stimulus=_named(finger, number))
            ends += [replace(at_end, at=start), replace(at_end, at=end)]
            moved[number] = replace(at_end, at=middle, load=finger.load - 2 * MIN_LOAD)
    return [*moved, *ends]


def _path_of(contact: Contact, now: float, plate: Plate) -> tuple[Point, Point, Point] | None:
    """Return start, middle and end of the path to solve for; None if the contact rests."""
    vx, vy = contact.motion.velocity(now)
    speed = math.hypot(vx, vy)
    if not speed:
        return None
    last_seen = contact.motion.places[-1][0]
    answer_delay = now - last_seen + _ANSWER_TIME + ONSET_RAMP / 2
    stretch_time = STRETCH / speed

    def position_after(delay: float) -> Point:
        return _on_plate((contact.x + vx * delay, contact.y + vy * delay), plate)

    start = position_after(answer_delay - stretch_time / 2)
    middle = position_after(answer_delay + stretch_time / 2)
    end = position_after(answer_delay + 3 * stretch_time / 2)
    return start, middle, end


def _on_plate(position: Point, plate: Plate) -> Point:
    x, y = position
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)


def _comes_near(path: Sequence[Point], others: Sequence[Finger]) -> bool:
    """Whether a path comes within a fingertip's radius of another finger."""
    for point in path:
        if any(math.dist(point, other.at) < FINGERTIP_RADIUS for other in others):
            return True
    return False


def _named(finger: Finger, number: int) -> Stimulus | None:
    """Return the stimulus of a finger; a stimulus without a name gets a unique one."""
    if finger.stimulus is None:
        return None
    return replace(finger.stimulus, name=finger.name or f"finger {number}")


def _is_steady_and_alone(finger: Finger, others: Sequence[Finger]) -> bool:
    """Whether a finger feels nothing, or a steady content that no other finger may share."""
    if finger.stimulus is None:
        return True
    if finger.stimulus.modulation_hz is not None:
        return False
    return not any(finger.may_feel_one_with(other) for other in others)


def _on_paths(table: LocalizationTable, solution: Answer, count: int) -> Answer:
    """Return the answer for the first fingers; the others are the ends of their paths."""
    if len(solution.asked) == count:
        return solution
    positions = [finger.at for finger in solution.asked]
    paths = [[number] for number in range(count)]
    for end in range(count, len(positions)):
        distances = [math.dist(middle, positions[end]) for middle in positions[:count]]
        paths[distances.index(min(distances))].append(end)
    if solution.layers:
        tones = solution.tones
        rows = np.array(tones.rows)
        owners = np.array(tones.owners)
        gains = np.array(tones.gains)
        solution = with_tones(table, solution, rows, tones.weights, owners, gains, paths)
    return replace(
        solution,
        asked=solution.asked[:count],
        contents=solution.contents.of_first(count),
        held=tuple([vibration for vibration in solution.held if vibration[0] < count]),
    )


@dataclass(frozen=True)
class Crossfades:
    """Finds the way from the contents that play to a better answer for the same fingers.

    question: has the lasting targets, whose fingers rest; shape: adds envelopes.
    """

    table: LocalizationTable
    question: Question
    capabilities: PlaybackCapabilities
    shape: Shape | None = None

    def steps(self) -> tuple[Selection, ...]:
        """Return the selection after each step; new contents are marked as cross-faded (`is_led`).

        Other frequencies must promise the worst finger 2 dB more, other weights alone 0.5 dB more,
        in both cases to the same fingers and at no lower level. The way ends with the last step
        that promises more. Without a better answer the only step is the present selection, if its
        promised contrast differs by 0.5 dB from the promise made while fingers moved. There is no
        step if no content plays.
        """
        if self.capabilities.drive_mode != UNRESTRICTED or not self.question.playing:
            return ()
        playing = _by_finger(self.question.playing.values())
        restated = tuple[Selection, ...]()
        for keeps in (False, True):
            goal = answered(
                self.table, self.question, self.question.lasting, self.capabilities, keeps=keeps
            )
            goal_voices = _by_finger(self._selection(goal, shape=self.shape).contents)
            is_same_service = _served(goal_voices) == _served(playing)
            if not is_same_service or len(goal.layers) != len(playing):
                continue
            present = self._answer_of(goal, playing)
            restated = self._restated(present, playing)
            changes = {
                key: voices for key, voices in goal_voices.items() if _differ(voices, playing[key])
            }
            if not _is_worth_it(goal, present, playing, changes):
                continue
            steps = self._in_order(goal, playing, changes)
            if steps:
                return steps
        return restated

    def _restated(self, present: Answer, playing: _Voices) -> tuple[Selection, ...]:
        """Return the present selection with its present promises; nothing if they are known."""
        known_promises = dict[ContactKey, float]()
        for content in self.question.playing.values():
            for felt in content.finger_sensations:
                known_promises[felt.contact.key] = felt.sensation.promised_contrast_db or 0.0
        selection = self._selection_of_playing(present, playing)
        for felt in selection.finger_sensations:
            promise = felt.sensation.promised_contrast_db or 0.0
            known_promise = known_promises.get(felt.contact.key, promise)
            if abs(promise - known_promise) >= WORTH_OF_WEIGHTS:
                return (selection,)
        return ()

    def _in_order(self, goal: Answer, playing: _Voices, changes: _Voices) -> tuple[Selection, ...]:
        """Return the selection after each step, the best content first; empty without an order.

        A content that can follow now never prevents a later one, so no other order gets further
        than this one.
        """
        remaining = {**changes}
        steps = list[Selection]()
        promised_worst = -math.inf
        while remaining:
            options = list[tuple[float, ContactKey]]()
            answers = dict[ContactKey, Answer]()
            for key, voices in remaining.items():
                if self._may_follow(playing, key, voices):
                    answers[key] = self._answer_of(goal, {**playing, key: voices})
                    options.append((worst_of(answers[key]), key))
            if not options:
                return ()
            worst, best_key = max(options, key=lambda option: option[0])
            playing = {**playing, best_key: remaining.pop(best_key)}
            if remaining or not steps or worst >= promised_worst + SAME_LEVEL:
                steps.append(self._selection_of_playing(answers[best_key], playing))
            promised_worst = worst
        return tuple(steps)

    def _may_follow(self, playing: _Voices, key: ContactKey, voices: tuple[Content, ...]) -> bool:
        """Whether a finger's content can be cross-faded to another one while all contents play.

        While both sound, they must be 30 Hz from all other contents and from each other, and within
        the limits of the amplifiers.
        """
        if not _is_tuned(playing[key], voices):
            contents = _all_of({**playing, key: voices})
        elif _is_apart(voices[0], [contents[0] for contents in playing.values()]):
            contents = [*_all_of(playing), *voices]
        else:
            return False
        layers = [content.layer for content in contents]
        return self.capabilities.limits.factor_within(layers, self.table) >= 1 - NEARLY

    def _answer_of(self, goal: Answer, voices: _Voices) -> Answer:
        """Return an answer with the tones of contents that play together, and its promises."""
        rows = list[int]()
        drives = list[list[complex]]()
        owners = list[int]()
        for number, stream in enumerate(goal.contents.streams):
            owner, _ = self.question.lasting[stream.targets[0]]
            for content in voices[owner.key]:
                frequencies, bases = base_amplitudes(content.layer.excitation, self.table.eras)
                content_rows = self.table.rows_of(frequencies)
                rows += content_rows.tolist()
                drives += (bases / self.table.highest_drives[content_rows]).tolist()
                owners += [number] * len(frequencies)
        gains = np.ones(len(rows))
        return with_tones(self.table, goal, np.array(rows), drives, np.array(owners), gains)

    def _selection_of_playing(self, present: Answer, voices: _Voices) -> Selection:
        """Return the selection of contents that play together, with their sensations."""
        selection = self._selection(present)
        contents = list[Content]()
        for key, answered_voices in _by_finger(selection.contents).items():
            for content, answered_voice in zip(voices[key], answered_voices, strict=True):
                contents.append(replace(content, sensations=answered_voice.sensations))
        return replace(selection, contents=tuple(contents))

    def _selection(self, solution: Answer, *, shape: Shape | None = None) -> Selection:
        """Return the selection of an answer; its contents are marked as cross-faded."""
        targets = self.question.lasting
        selection = selection_of(self.table, self.question, solution, targets, shape=shape)
        contents = [replace(content, is_led=True) for content in selection.contents]
        return replace(selection, contents=tuple(contents))


def _by_finger(contents: Iterable[Content]) -> _Voices:
    """Return contents by finger, each followed by its side bands."""
    voices = dict[ContactKey, tuple[Content, ...]]()
    for content in sorted(contents, key=lambda content: content.key.voice):
        key = content.key.finger
        voices[key] = (*voices.get(key, ()), content)
    return voices


def _all_of(voices: _Voices) -> list[Content]:
    """Return all contents and side bands."""
    return [content for contents in voices.values() for content in contents]


def _served(voices: _Voices) -> dict[ContactKey, tuple[int, set[ContactKey]]]:
    """Return the number of voices and the contacts of each finger's content."""
    served = {}
    for key, contents in voices.items():
        served[key] = (len(contents), {*contents[0].contact_keys})
    return served


def _is_worth_it(goal: Answer, present: Answer, playing: _Voices, changes: _Voices) -> bool:
    """Whether an answer promises the worst finger clearly more, and no finger a lower level."""
    is_tuned = any(_is_tuned(playing[key], voices) for key, voices in changes.items())
    gain = worst_of(goal) - worst_of(present)
    required_gain = WORTH if is_tuned else WORTH_OF_WEIGHTS
    return gain >= required_gain and not _is_weaker(goal, present)


def _is_apart(content: Content, others: Iterable[Content]) -> bool:
    """Whether a content is at least 30 Hz from all others."""
    frequency = content.frequency or 0.0
    return all(abs(frequency - (other.frequency or 0.0)) >= APART_HZ for other in others)


def _is_tuned(playing: Sequence[Content], goal: Sequence[Content]) -> bool:
    """Whether the frequencies of two contents and their side bands differ."""
    playing_frequencies = [content.frequency for content in playing]
    return playing_frequencies != [content.frequency for content in goal]


def _differ(goal: Sequence[Content], playing: Sequence[Content]) -> bool:
    """Whether a finger feels a difference between two contents and their side bands."""
    if _is_tuned(playing, goal):
        return True
    for new_content, old_content in zip(goal, playing, strict=True):
        new_phasors = _phasors(new_content)
        old_phasors = _phasors(old_content)
        amplitudes = [abs(phasor) for phasor in (*new_phasors.values(), *old_phasors.values())]
        tolerance = _SAME * max(amplitudes)
        for name in {*new_phasors, *old_phasors}:
            change = new_phasors.get(name, 0) - old_phasors.get(name, 0)
            if abs(change) > tolerance:
                return True
    return False


def _phasors(content: Content) -> dict[str, complex]:
    """Return the complex amplitude of each ERA [m]."""
    return {name: tone.phasor for name, tone in content.layer.excitation.items()}


def _is_weaker(goal: Answer, present: Answer) -> bool:
    """Whether a finger with a content feels a clearly lower level."""
    for new, old in zip(goal.fingers, present.fingers, strict=True):
        loss = old.promised_level_db_sl - new.promised_level_db_sl
        if new.layer is not None and loss > _SHORT_OF:
            return True
    return False
