"""Contents of fingers from one answer of the table, a layer for each.

A frequency that a finger feels is content: it is kept, and its phase at that finger, unless another
one serves more fingers. What promises more is led over to once all rest (`crossfades`).
"""

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from controller.play.ahead import felt_on_ways, foreign_on_ways, with_ways
from controller.play.capabilities import PlaybackCapabilities
from controller.play.content import Content, Prediction, Selection, not_served
from controller.play.intent import MAX_DB_SL, Target, band_of_table
from controller.sources.contacts import Contact, ContactKey
from model.answer.answer import (
    HELD_BACK,
    IMPERCEPTIBLE_DB_SL,
    MIN_CONTRAST_DB,
    OWN_CONTRAST_DB,
    SHARED,
    Answer,
    Layer,
    Sensation,
)
from model.answer.plan import answer
from model.answer.stimulus import ANY, BY_NAME, NEVER, Finger, Placement, Stimulus
from model.arrays import Complex64Array, FloatArray
from model.table.table import LocalizationTable
from model.vibration import Excitation, base_amplitudes

_SHORT_OF = 1.0  # dB; by which what keeps its frequency may be weaker than asked
_SIDE_BANDS = 2

LIMITS_LEAVE_NOTHING = "the limits of the amplifiers allow nothing that is felt; raise them"
NEIGHBOURS_LEAVE_NOTHING = (
    "a quiet finger must stay at -10 dB SL, but at every level that reaches the target it does "
    "not; lift or move that finger away"
)

Shape = Callable[[Placement, Layer, bool], Layer]
"""Adds the envelopes of a layer; whether it continues what plays in it, without an onset."""


def answered(
    table: LocalizationTable,
    targets: Sequence[tuple[Contact, Target]],
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    *,
    before: Mapping[tuple[ContactKey, int], Content],
    protected: frozenset[ContactKey] = frozenset(),
    keeps: bool = True,
    now: float = math.inf,
    avoided_hz: Sequence[float] = (),
) -> Answer:
    """Answer the fingers of targets and of quiet contacts, those that move on their ways.

    before: what fingers feel now, whose frequencies are kept, if any are, unless others serve more
    fingers, or more strongly; now [s]: infinite where all rest; avoided_hz: frequencies that
    play beside it. Raises InputError for fingers that are too close.
    """
    is_shaped = capabilities.envelope_support.onset_knots > 0
    fingers = fingers_of(table, targets, quiet, capabilities, protected)
    if len(targets) > 1 or targets[0][1].modulation_hz is not None:
        fingers = _as_layers_allow(fingers, len(targets), capabilities)
    if math.isfinite(now):
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
    kept = _kept(fingers, targets, before) if keeps else fingers
    if kept == fingers:
        return request(fingers)
    found = request(kept)
    served, lowered = len(found.layers), _lowered_db(found)
    is_loud = lowered < _SHORT_OF
    if is_loud and served == len(targets):
        return found
    other = request(fingers)
    is_better = not is_loud and _lowered_db(other) < lowered
    return other if (len(other.layers), is_better) > (served, False) else found


def selection_of(
    table: LocalizationTable,
    found: Answer,
    targets: Sequence[tuple[Contact, Target]],
    quiet: Sequence[Contact],
    *,
    before: Mapping[tuple[ContactKey, int], Content],
    shape: Shape | None = None,
    protected: frozenset[ContactKey] = frozenset(),
    is_in_phase: bool = True,
) -> Selection:
    """Return the contents of an answer to the fingers of targets and quiet contacts.

    before: what fingers feel now, whose phases are kept if is_in_phase.
    """
    count = len(targets) + len(quiet)
    sensed = felt_on_ways(found, count)
    here = replace(found, asked=found.asked[:count])  # without the ends of ways
    fields: Complex64Array | None = None  # seldom needed
    contents: list[Content] = []
    skipped: list[Prediction] = []
    felt, unfelt = [*zip(targets, sensed, strict=False)], set[ContactKey]()
    for (contact, _), each in felt:
        if each.verdict == HELD_BACK:
            skipped.append(_held_back(contact, each))
        elif (reason := _why_unfelt(each)) is not None:
            unfelt.add(contact.key)
            skipped.append(not_served(contact, reason))
    for layer in found.layers:
        layer = replace(layer, fingers=tuple([each for each in layer.fingers if each < count]))
        own, sensations = list[tuple[Contact, Target]](), list[Sensation]()
        for number in layer.fingers:
            finger, sensation = felt[number]
            if finger[0].key not in unfelt:
                own.append(finger)
                sensations.append(sensation)
        if not own:
            continue
        (contact, target), placed, voices = own[0], here.placement(layer), layer.voices
        carrier = before.get((contact.key, target.voice))
        is_continued = carrier is not None and all(
            (then := before.get((contact.key, voice))) is not None
            and then.frequency == played.frequency
            for voice, played in enumerate(voices)
        )
        for voice, played in enumerate(voices):
            if layer.side_bands or (is_in_phase and carrier is not None):
                if fields is None:
                    places = [each.finger.at for each in sensed[: len(targets)]]
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
    levels = zip(contacts, foreign_on_ways(found, count), strict=True)
    return Selection(
        tuple(targets),
        tuple(quiet),
        tuple(contents),
        None if contents else skipped[0].held_back,
        tuple(skipped),
        foreign_levels={contact.key: by_set for contact, by_set in levels},
        protected=protected,
    )


def fingers_of(
    table: LocalizationTable,
    targets: Sequence[tuple[Contact, Target]],
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    protected: frozenset[ContactKey] = frozenset(),
) -> list[Finger]:
    """Return the fingers of targets, then the quiet ones.

    protected: contacts that must not notice the vibrations of others. The duration counts of a
    single target, and of what ends before an onset would have settled.
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
        found.append(Finger((contact.x, contact.y), load=contact.load, max_foreign_db_sl=bound))
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
    """The fingers, steady where there are no layers for side bands, of low priority first.

    A layer is left to a click.
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
    """The fingers with the frequencies that they feel now, where their bands allow it."""
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
    """By how much the weakest finger is weaker than asked."""
    return max([each.lowered_db for each in found.fingers], default=0.0)


def felt_db_sl(felt: Sensation) -> float:
    """Return the level of a finger: promised of what lasts, over its duration as modelled."""
    stimulus = felt.finger.stimulus
    lasts = stimulus is None or stimulus.duration is None
    return felt.promised_level_db_sl if lasts else felt.level_db_sl


def _why_unfelt(felt: Sensation) -> str | None:
    """Return why a finger would not feel what is played for it; None if it does."""
    stimulus = felt.finger.stimulus
    if felt.layer is None or stimulus is None:
        return None
    if stimulus.is_limit and felt.level_db_sl <= 0:
        return NEIGHBOURS_LEAVE_NOTHING
    return LIMITS_LEAVE_NOTHING if felt_db_sl(felt) < 0 <= stimulus.level_db_sl else None


def _predictions(
    targets: Sequence[tuple[Contact, Target]],
    sensations: Sequence[Sensation],
    layer: Layer,
) -> tuple[Prediction, ...]:
    """What is predicted of a layer's finger, and of those that share it."""
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
    """What is said of a finger whose vibration is held back, and by how much."""
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
    fields = fields[:, :, number]
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
    """Complex acceleration at a finger, by frequency [Hz]."""
    frequencies, bases = base_amplitudes(excitation, table.eras)
    rows = table.rows_of(frequencies)
    weights = bases / table.highest_drives[rows]
    felt = (weights * fields[rows]).sum(axis=1)
    return dict(zip(frequencies.tolist(), felt.tolist(), strict=True))
