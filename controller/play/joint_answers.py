"""Joint answers: from targets to contents by one answer of the table, and ways to better answers.

A frequency that a finger feels is content: it is kept, and its phase at that finger, unless another
one serves more fingers.

Moving fingers are answered for 16 mm of their way, at three places at once, with their own content
and as quiet for all others: around the middle of the 8 mm from where a finger is once the weights
have half changed, to where they do again. What is promised is the mean power there on drawn plates,
with a share of others' contents for the side bands of weights that change (`model.answer.promise`).

What fingers feel depends on the order of their arrival, since frequencies are kept. Once all rest,
the answer with none kept is led to along cross-fades (`Crossfades`), one content after the other,
so that others feel little of it; where only weights change, as after a finger has left, along the
same ramp within the layer. Each step keeps 30 Hz between all that sounds at once, the old tone
included; where no order of the contents does, what plays is left. Between the steps the promise is
that of what plays then.
"""

import cmath
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from controller.play.intent import (
    MAX_DB_SL,
    Content,
    Prediction,
    Question,
    Selection,
    Target,
    Targets,
    band_of_table,
    not_served,
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
    SHARED,
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
"""Way [m] after which a moving finger is asked anew; it is answered for twice as much of it."""

WORTH = 2.0
"""How much more [dB] the worst finger must be promised for other frequencies."""

WORTH_OF_WEIGHTS = 0.5
"""How much more [dB] it must be promised for other weights alone."""

LIMITS_LEAVE_NOTHING = "the limits of the amplifiers allow nothing that is felt; raise them"

NEIGHBOURS_LEAVE_NOTHING = (
    "a quiet finger must stay at -10 dB SL, but at every level that reaches the target it does "
    "not; lift or move that finger away"
)

_ANSWER_TIME = 0.020  # s; until what is asked now has begun to play
_SHORT_OF = 1.0  # dB; by which what keeps its frequency may be weaker than asked
_SIDE_BANDS = 2
_SAME = 0.01  # of the largest amplitude of two drives: a difference that is not felt

Shape = Callable[[Placement, Layer, bool], Layer]
"""Adds the envelopes of a layer; without an onset where the last argument is true."""

_Voices = Mapping[ContactKey, tuple[Content, ...]]
"""A content and its side bands, by the finger whose content it is."""


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
    """Answer the fingers of some targets, moving ones on their ways; all others are quiet.

    keeps: whether frequencies that are felt now are kept, unless others serve more fingers, or more
    strongly. now [s]: infinite where all rest; avoided_hz: frequencies that play beside the answer.
    Raises InputError for fingers that are too close.
    """
    quiet = question.quiet_beside(targets)
    is_shaped = capabilities.envelope_support.onset_knots > 0
    fingers = fingers_of(table, targets, quiet, capabilities, question.protected)
    if len(targets) > 1 or targets[0][1].modulation_hz is not None:
        fingers = _as_layers_allow(fingers, len(targets), capabilities)
    contacts = [*[contact for contact, _ in targets], *quiet]
    fingers = with_ways(fingers, contacts, now, table.plate)
    request = partial(
        answer,
        table,
        drive_mode=capabilities.drive_mode,
        shaped=is_shaped and not targets[0][1].is_short,  # all or none
        limits=capabilities.limits,
        avoided_hz=avoided_hz,
    )
    kept = _kept(fingers, targets, question.before) if keeps else fingers
    found = request(kept)
    served, lowered = len(found.layers), _lowered_db(found)
    is_loud = lowered < _SHORT_OF
    if kept != fingers and not (is_loud and served == len(targets)):
        other = request(fingers)
        is_better = not is_loud and _lowered_db(other) < lowered
        if (len(other.layers), is_better) > (served, False):
            found = other
    return _on_ways(table, found, len(contacts))


def fingers_of(
    table: LocalizationTable,
    targets: Sequence[tuple[Contact, Target]],
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    protected: frozenset[ContactKey] = frozenset(),
) -> list[Finger]:
    """Return the fingers of targets, then the quiet ones.

    protected: contacts that must not notice the vibrations of others. A duration is asked for only
    with a single target, and with pulses that end before an onset would have settled.
    """
    found = []
    for contact, target in targets:
        is_over = target.course is None and (len(targets) == 1 or target.is_short)
        duration = None
        if is_over and target.pulse is not None and target.pulse.is_raised:
            duration = target.pulse.duration
        stimulus = Stimulus(
            MAX_DB_SL if target.level_db_sl is None else target.level_db_sl,
            playable_band(target.band, table.frequencies, capabilities.limits.frequencies),
            duration,
            None if duration is not None else target.modulation_hz,
            is_limit=target.level_db_sl is None,
            name=target.content,
            course=target.course,
        )
        never = target.is_own or target.course is not None  # each has begun at its own time
        sharing = NEVER if never else ANY if target.may_share else BY_NAME
        found.append(
            Finger(
                (contact.x, contact.y),
                stimulus,
                contact.load,
                target.priority,
                sharing,
                min_contrast_db=OWN_CONTRAST_DB if target.is_own else -math.inf,
                max_foreign_db_sl=IMPERCEPTIBLE_DB_SL if contact.key in protected else math.inf,
            )
        )
    for contact in quiet:
        bound = IMPERCEPTIBLE_DB_SL if contact.key in protected else math.inf
        found.append(
            Finger(
                (contact.x, contact.y),
                load=contact.load,
                is_protected=not contact.is_surplus,
                max_foreign_db_sl=bound,
            )
        )
    return found


def playable_band(
    band: tuple[float, float] | None, frequencies: FloatArray, playable: tuple[float, float]
) -> tuple[float, float]:
    """Return the lowest and highest frequency [Hz] of a band that can be played.

    A band that shares no frequency of a table with what is playable is ignored.
    """
    low, high = playable
    if band is not None:
        of_table = band_of_table(band, frequencies)
        together = max(low, of_table[0]), min(high, of_table[1])
        if ((frequencies >= together[0]) & (frequencies <= together[1])).any():
            low, high = together
    return low, high


def _as_layers_allow(
    fingers: Sequence[Finger], targets: int, capabilities: PlaybackCapabilities
) -> list[Finger]:
    """Return fingers, those of low priority steady where no layers are left for side bands.

    One layer is left free for a click.
    """
    found, spare = [*fingers], capabilities.layers - targets - 1
    for number in sorted(range(targets), key=lambda each: -found[each].priority):
        stimulus = found[number].stimulus
        if stimulus is not None and stimulus.modulation_hz is not None:
            if spare >= _SIDE_BANDS:
                spare -= _SIDE_BANDS
            else:
                steady = replace(stimulus, modulation_hz=None)
                found[number] = replace(found[number], stimulus=steady)
    return found


def _kept(
    fingers: Sequence[Finger],
    targets: Sequence[tuple[Contact, Target]],
    before: Mapping[tuple[ContactKey, int], Content],
) -> list[Finger]:
    """Return fingers tuned to the frequencies that they feel now, where their bands allow it."""
    kept = [*fingers]
    for number, (contact, target) in enumerate(targets):
        then, stimulus = before.get((contact.key, target.voice)), fingers[number].stimulus
        frequency = None if then is None else then.frequency
        if stimulus is None or frequency is None:
            continue
        low, high = stimulus.band_hz
        if low <= frequency <= high:
            tuned = replace(stimulus, band_hz=(frequency, frequency))
            kept[number] = replace(fingers[number], stimulus=tuned)
    return kept


def _lowered_db(found: Answer) -> float:
    """Return by how many dB the weakest finger is weaker than asked."""
    return max([each.lowered_db for each in found.fingers], default=0.0)


def selection_of(
    table: LocalizationTable,
    question: Question,
    found: Answer,
    targets: Targets,
    *,
    shape: Shape | None = None,
    is_in_phase: bool = True,
) -> Selection:
    """Return the contents of an answer to some targets of a question.

    The phases of contents that play are kept if is_in_phase; shape: adds envelopes.
    """
    before, quiet = question.before, question.quiet_beside(targets)
    fields: Complex64Array | None = None  # seldom needed
    contents: list[Content] = []
    skipped: list[Prediction] = []
    felt, unfelt = [*zip(targets, found.fingers, strict=False)], set[ContactKey]()
    for (contact, _), each in felt:
        if each.verdict == HELD_BACK:
            skipped.append(_held_back(contact, each))
        elif (reason := _why_unfelt(each)) is not None:
            unfelt.add(contact.key)
            skipped.append(not_served(contact, reason))
    for layer in found.layers:
        own, sensations = list[tuple[Contact, Target]](), list[Sensation]()
        for number in layer.fingers:
            finger, sensation = felt[number]
            if finger[0].key not in unfelt:
                own.append(finger)
                sensations.append(sensation)
        if not own:
            continue
        (contact, target), placed, voices = own[0], found.placement(layer), layer.voices
        carrier = before.get((contact.key, target.voice))
        is_continued = carrier is not None and all(
            (then := before.get((contact.key, voice))) is not None
            and then.frequency == played.frequency
            for voice, played in enumerate(voices)
        )
        for voice, played in enumerate(voices):
            if layer.side_bands or (is_in_phase and carrier is not None):
                if fields is None:
                    places = [each.at for each in found.asked[: len(targets)]]
                    fields = table.unit_fields(np.array(places), contacts=places)
                then = carrier if is_continued else None
                played = _in_phase(played, then, fields, layer.fingers[0], table)
            contents.append(
                Content(
                    (contact.key, target.voice + voice),
                    tuple(own),
                    placed,
                    shape(placed, played, is_continued) if shape and not target.course else played,
                    () if voice else _predictions(own, sensations, layer),
                )
            )
    contacts = [*[contact for contact, _ in targets], *quiet]
    heard = np.array(found.tones.foreign_db_sl)
    levels = zip(contacts, np.where(np.isnan(heard), -math.inf, heard).tolist(), strict=False)
    return Selection(
        targets,
        quiet,
        tuple(contents),
        None if contents else skipped[0].held_back,
        tuple(skipped),
        foreign_levels={contact.key: by_set for contact, by_set in levels},
        protected=question.protected,
    )


def _why_unfelt(felt: Sensation) -> str | None:
    """Return why a finger would not feel its own layer; None if it does."""
    stimulus = felt.finger.stimulus
    if felt.layer is None or stimulus is None:
        return None
    if stimulus.is_limit and felt.level_db_sl <= 0:
        return NEIGHBOURS_LEAVE_NOTHING
    return LIMITS_LEAVE_NOTHING if felt_db_sl(felt) < 0 <= stimulus.level_db_sl else None


def felt_db_sl(felt: Sensation) -> float:
    """Return the level [dB SL] of a finger: promised if it lasts, else nominal over its time."""
    stimulus = felt.finger.stimulus
    lasts = stimulus is None or stimulus.duration is None
    return felt.promised_level_db_sl if lasts else felt.level_db_sl


def _predictions(
    targets: Sequence[tuple[Contact, Target]],
    sensations: Sequence[Sensation],
    layer: Layer,
) -> tuple[Prediction, ...]:
    """Return the predictions for a layer's finger, and for those that share it."""
    first, own = targets[0]
    shares = (
        f"shares the vibration of finger {first.key.source} {first.key.id}; lift one, or move them "
        "apart"
    )
    predictions: list[Prediction] = []
    for (contact, target), felt in zip(targets, sensations, strict=True):
        predictions.append(
            Prediction(
                contact,
                felt_db_sl(felt),
                felt.contrast_db,
                felt.verdict,
                shares if felt.verdict == SHARED and contact is not first else None,
                felt.promised_contrast_db,
                felt.foreign_level_db_sl,
                layer.frequency,
                own.content,
                felt.level_db_sl,
                pauses=felt.pauses or target.pulse is not None,
            ).judged()
        )
    return tuple(predictions)


def _held_back(contact: Contact, felt: Sensation) -> Prediction:
    """Return the prediction for a finger whose vibration is held back, with the reason."""
    had = felt.promised_contrast_db
    least = max(MIN_CONTRAST_DB, felt.finger.min_contrast_db)
    if felt.is_disturbing:
        reason = "a protected finger would notice it; lower its level, or lift that finger"
    elif had is not None and had >= least:
        reason = (
            "too many contents for this plate: beside it another finger would not have had the "
            f"{MIN_CONTRAST_DB:g} dB of contrast, or more, that it requires; lift a finger, move "
            "it away, or widen its band"
        )
    else:
        figure = "" if had is None or not math.isfinite(had) else f", only {had:.1f} dB"
        reason = (
            f"too many contents for this plate: beside the others it would not have had {least:g} "
            f"dB of contrast{figure}; lift a finger, move it away, or widen its band"
        )
    return replace(
        not_served(contact, reason),
        promised_contrast_db=had,
        foreign_level_db_sl=felt.foreign_level_db_sl,
    )


def _in_phase(
    layer: Layer,
    before: Content | None,
    fields: Complex64Array,
    number: int,
    table: LocalizationTable,
) -> Layer:
    """Turn a layer so that its finger feels it in the phase of the tone before, 0 without any.

    Side bands in phase with their carrier modulate its amplitude, not its frequency: all have the
    phase of the carrier before. fields (f, eras, fingers): of each ERA at full stroke; number: of
    the finger.
    """
    fields = fields[:, :, [number]]
    felt = _felt(layer.excitation, fields, table)
    felt_before = {} if before is None else _felt(before.layer.excitation, fields, table)
    (then,) = felt_before.values() if len(felt_before) == 1 else (1.0,)
    turned = {}
    for name, tone in layer.excitation.items():
        now = felt[tone.frequency]
        change = cmath.phase(then / now) if now and then else 0.0
        turned[name] = replace(tone, phase=tone.phase + change)
    return replace(layer, excitation=turned)


def _felt(
    excitation: Excitation, fields: Complex64Array, table: LocalizationTable
) -> dict[float, complex]:
    """Return the complex acceleration at a finger, by frequency [Hz]."""
    frequencies, felt = table.driven(excitation, fields)
    return dict(zip(frequencies.tolist(), felt[:, 0].tolist(), strict=True))


def with_ways(
    fingers: Sequence[Finger], contacts: Sequence[Contact], now: float, plate: Plate
) -> list[Finger]:
    """Return the fingers of contacts at a time [s], moving ones at the middle of their ways.

    Two places as far before and after it as each way is long follow all of them, as fingers of the
    same stimulus that share its load: weights for these change more slowly. Fingers that may share
    with others, whose strength comes and goes, or that come too near another are only moved.
    """
    found, ends = [*fingers], list[Finger]()
    for number, (finger, contact) in enumerate(zip(fingers, contacts, strict=True)):
        vx, vy = contact.motion.velocity(now)
        if not (speed := math.hypot(vx, vy)):
            continue
        since = now - contact.motion.places[-1][0] + _ANSWER_TIME + ONSET_RAMP / 2
        reach = STRETCH / speed
        way = [
            _on_plate((contact.x + vx * each, contact.y + vy * each), plate)
            for each in (since - reach / 2, since + reach / 2, since + 3 * reach / 2)
        ]
        others = [each for each in (*found, *ends) if each is not finger]
        if any(math.dist(at, each.at) < FINGERTIP_RADIUS for at in way for each in others):
            continue
        found[number] = replace(finger, at=way[1])
        is_one = len({*way}) == len(way) and len(found) + len(ends) + 2 <= MAX_CONTACTS
        if is_one and _is_steady_and_alone(finger, others):
            name = finger.name or f"finger {number}"
            stimulus = finger.stimulus and replace(finger.stimulus, name=name)
            one = replace(finger, stimulus=stimulus, load=MIN_LOAD, sharing=MUST)
            ends += [replace(one, at=at) for at in (way[0], way[2])]
            found[number] = replace(one, at=way[1], load=finger.load - 2 * MIN_LOAD)
    return [*found, *ends]


def _on_plate(at: Point, plate: Plate) -> Point:
    x, y = at
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)


def _is_steady_and_alone(finger: Finger, others: Sequence[Finger]) -> bool:
    """Whether a finger feels nothing, or a steady content that no other finger may share."""
    if finger.stimulus is None:
        return True
    may_share = any(finger.may_feel_one_with(each) for each in others)
    return finger.stimulus.modulation_hz is None and not may_share


def _on_ways(table: LocalizationTable, found: Answer, count: int) -> Answer:
    """Return the answer for the first fingers; the others are ends of their ways."""
    if len(found.asked) == count:
        return found
    ways, places = [[number] for number in range(count)], [each.at for each in found.asked]
    for end in range(count, len(places)):
        near = [math.dist(at, places[end]) for at in places[:count]]
        ways[near.index(min(near))].append(end)
    if found.layers:
        tones = found.tones
        of_tones = np.array(tones.rows), tones.weights, np.array(tones.owners)
        found = with_tones(table, found, *of_tones, np.array(tones.gains), ways)
    return replace(
        found,
        asked=found.asked[:count],
        contents=found.contents.of_first(count),
        held=tuple([each for each in found.held if each[0] < count]),
    )


@dataclass(frozen=True)
class Crossfades:
    """Finds the way from what plays to a better answer for the same fingers.

    question: what lasts, where its fingers rest; shape: adds envelopes.
    """

    table: LocalizationTable
    question: Question
    capabilities: PlaybackCapabilities
    shape: Shape | None = None

    def steps(self) -> tuple[Selection, ...]:
        """Return the selection after each step; contents that are led to are marked.

        Other frequencies must promise 2 dB more to the worst finger, other weights alone 0.5 dB;
        either to the same fingers, and not more weakly. The way ends where a step promises no more.
        Where nothing is better, the only step is what plays, if its promised contrast differs by
        0.5 dB from what was promised while fingers moved. No step where nothing plays.
        """
        if self.capabilities.drive_mode != UNRESTRICTED or not self.question.before:
            return ()
        question, same = self.question, tuple[Selection, ...]()
        playing = _by_finger(question.before.values())
        for keeps in (False, True):
            goal = answered(self.table, question, question.lasting, self.capabilities, keeps=keeps)
            found = _by_finger(self._selection(goal, shape=self.shape).contents)
            if _served(found) != _served(playing) or len(goal.layers) != len(playing):
                continue
            now = self._mixed(goal, playing)
            same = self._restated(now, playing)
            led = {key: each for key, each in found.items() if _differ(each, playing[key])}
            is_tuned = any(_is_tuned(playing[key], each) for key, each in led.items())
            gain = worst_of(goal) - worst_of(now)
            if gain < (WORTH if is_tuned else WORTH_OF_WEIGHTS) or _is_weaker(goal, now):
                continue
            if steps := self._in_order(goal, playing, led):
                return steps
        return same

    def _restated(self, now: Answer, playing: _Voices) -> tuple[Selection, ...]:
        """Return what plays with its present promises; nothing if they are known."""
        found, said = self._felt(now, playing), dict[ContactKey, float]()
        for content in self.question.before.values():
            for each in content.predictions:
                said[each.contact.key] = each.promised_contrast_db or 0.0
        for each in found.predictions:
            promised = each.promised_contrast_db or 0.0
            if abs(promised - said.get(each.contact.key, promised)) >= WORTH_OF_WEIGHTS:
                return (found,)
        return ()

    def _in_order(self, goal: Answer, playing: _Voices, led: _Voices) -> tuple[Selection, ...]:
        """Return the selection after each step, the best content first; none if none may follow.

        A content that may follow hinders none later, so no other order goes on where this ends.
        """
        left, steps, before = {**led}, list[Selection](), -math.inf
        while left:
            options = []
            for key, voices in left.items():
                if self._may_follow(playing, key, voices):
                    after = {**playing, key: voices}
                    options.append((self._mixed(goal, after), key, after))
            if not options:
                return ()
            mixed, key, playing = max(options, key=lambda each: worst_of(each[0]))
            del left[key]
            if left or not steps or worst_of(mixed) >= before + SAME_LEVEL:
                steps.append(self._felt(mixed, playing))
            before = worst_of(mixed)
        return tuple(steps)

    def _may_follow(self, playing: _Voices, key: ContactKey, voices: tuple[Content, ...]) -> bool:
        """Whether a finger's content may be led to another beside all that plays.

        While both sound they are 30 Hz from all others and each other, and within the limits of the
        amplifiers.
        """
        beside = [one for each in playing.values() for one in each]
        if not _is_tuned(playing[key], voices):
            beside = [one for one in beside if one not in playing[key]]
        elif any(
            abs((voices[0].frequency or 0.0) - (each[0].frequency or 0.0)) < APART_HZ
            for each in playing.values()
        ):
            return False
        total = [one.layer for one in (*beside, *voices)]
        return self.capabilities.limits.factor_within(total, self.table) >= 1 - NEARLY

    def _mixed(self, goal: Answer, voices: _Voices) -> Answer:
        """Return an answer with the tones of contents that are felt together, and its promises."""
        drives, owners = [], list[int]()
        rows, table = list[int](), self.table
        for number, stream in enumerate(goal.contents.streams):
            for one in voices[self.question.lasting[stream.targets[0]][0].key]:
                frequencies, bases = base_amplitudes(one.layer.excitation, table.eras)
                at = table.rows_of(frequencies)
                rows += at.tolist()
                drives += (bases / table.highest_drives[at]).tolist()
                owners += [number] * len(frequencies)
        every = np.array(rows), drives, np.array(owners), np.ones(len(rows))
        return with_tones(table, goal, *every)

    def _felt(self, mixed: Answer, voices: _Voices) -> Selection:
        """Return the selection of contents that are felt together, with their predictions."""
        found = self._selection(mixed)
        contents = [
            replace(one, predictions=predicted.predictions)
            for key, each in _by_finger(found.contents).items()
            for one, predicted in zip(voices[key], each, strict=True)
        ]
        return replace(found, contents=tuple(contents))

    def _selection(self, found: Answer, *, shape: Shape | None = None) -> Selection:
        targets = self.question.lasting
        chosen = selection_of(self.table, self.question, found, targets, shape=shape)
        led = [replace(each, is_led=True) for each in chosen.contents]
        return replace(chosen, contents=tuple(led))


def _by_finger(contents: Iterable[Content]) -> _Voices:
    found: dict[ContactKey, tuple[Content, ...]] = {}
    for each in sorted(contents, key=lambda one: one.key[1]):
        found[each.key[0]] = (*found.get(each.key[0], ()), each)
    return found


def _served(voices: _Voices) -> dict[ContactKey, tuple[int, set[ContactKey]]]:
    """Return the number of voices and the contacts of each finger's content."""
    return {
        key: (len(each), {contact.key for contact, _ in each[0].targets})
        for key, each in voices.items()
    }


def _is_tuned(then: Sequence[Content], now: Sequence[Content]) -> bool:
    """Whether frequencies differ."""
    return [each.frequency for each in then] != [each.frequency for each in now]


def _differ(now: Sequence[Content], then: Sequence[Content]) -> bool:
    """Whether any finger feels a difference between two contents of one."""
    if _is_tuned(then, now):
        return True
    for one, other in zip(now, then, strict=True):
        new, old = (
            {name: tone.phasor for name, tone in each.layer.excitation.items()}
            for each in (one, other)
        )
        least = _SAME * max(map(abs, (*new.values(), *old.values())))
        if any(abs(new.get(name, 0) - old.get(name, 0)) > least for name in {*new, *old}):
            return True
    return False


def _is_weaker(goal: Answer, now: Answer) -> bool:
    """Whether a finger feels clearly less of its own."""
    return any(
        new.promised_level_db_sl < old.promised_level_db_sl - _SHORT_OF
        for new, old in zip(goal.fingers, now.fingers, strict=True)
        if new.layer is not None
    )
