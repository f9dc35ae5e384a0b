"""Several contents at once: the requests of all fingers, one answer, and a layer for each content.

A frequency that a finger feels is content: it is kept, and its phase at that finger, unless another
one promises 3 dB more to the worst finger, or serves more of them. While a finger moves, only the
latter counts: another frequency begins with an onset, for which the next place does not wait.
"""

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from controller.play.capabilities import PlaybackCapabilities, amplitudes_of
from controller.play.content import HELD_BACK, SHARED, Content, Prediction, Selection, not_served
from controller.play.intent import Target
from controller.play.table_query import fingers_of, question_of, requests_of
from controller.sources.contacts import Contact, ContactKey
from model.answer import request
from model.answer.answer import answer
from model.answer.modulation import with_gains
from model.answer.pattern import ONSET_RAMP, Pattern
from model.answer.promised import share_stroke
from model.answer.question import MIN_LEVEL_DB_SL, Question
from model.answer.request import OWN_CONTRAST_DB, Answer, Finger, Layer, Request
from model.arrays import Complex64Array
from model.choice import NEARLY
from model.finger.perception import decibels
from model.table.table import LocalizationTable
from model.vibration.excitation import Excitation, base_amplitudes

KEPT_WITHIN = 3.0
"""How much more [dB] another frequency must promise to take the place of one that is felt."""

_SIDE_BANDS = 2
_SILENT_DB = -60.0  # a gain by which a content is not felt

LIMITS_LEAVE_NOTHING = "the limits of the amplifiers allow nothing that is felt; raise them"

Shape = Callable[[Question, Pattern, bool], Pattern]
"""Adds the envelopes of a pattern; whether it continues what its layer plays, without an onset."""


def unshaped(question: Question, pattern: Pattern, is_continued: bool) -> Pattern:
    """Return a pattern as it is."""
    return pattern


def query_jointly(
    table: LocalizationTable,
    targets: Sequence[tuple[Contact, Target]],
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    *,
    before: Mapping[tuple[ContactKey, int], Content],
    shape: Shape,
    protected: frozenset[ContactKey] = frozenset(),
    is_moving: bool = False,
) -> Selection:
    """Answer the requests of several targets with a content for each; takes some 20 ms.

    before: what fingers feel now; protected: those that must not notice others' contents;
    is_moving: whether only their places have changed. Raises InputError for fingers that are too
    close.
    """
    playable = capabilities.frequencies
    requests = _as_layers_allow(
        requests_of(table, targets, playable, protected), capabilities.layers
    )
    fingers = fingers_of(quiet, protected)
    kept = _kept(requests, targets, before)
    kept_within = math.inf if is_moving else KEPT_WITHIN
    mode = capabilities.drive_mode
    found = _answer(table, requests, fingers, kept, kept_within, playable, mode)
    strokes = table.strokes

    def within(found: Answer) -> float:
        tones = [each for layer in found.layers for each in _tones_of(layer)]
        return capabilities.factor_within(amplitudes_of(tones), strokes)

    free, factor = found, within(found)
    if factor < 1 - NEARLY:
        gains = _gains_db(requests, found, capabilities, strokes)
        lowered = with_gains(table, found, gains)
        if lowered is None:  # who is lowered is not served any more: by the rule, then
            softer = [_at_gain(*each) for each in zip(requests, found.layers, gains, strict=True)]
            lowered = answer(table, softer, fingers, drive_mode=mode, playable=playable)
        found = lowered
        factor = within(found)
    change = float(decibels(factor))
    unfelt = {
        number
        for number, (then, now) in enumerate(zip(free.layers, found.layers, strict=True))
        if now.promised_level_db_sl + change < 0 <= then.promised_level_db_sl
    }

    @cache
    def fields() -> Complex64Array:
        places = [each.at for each in requests]
        return table.unit_fields(np.array(places), contacts=places)

    contents: list[Content] = []
    skipped: list[Prediction] = []
    for number, ((contact, target), layer) in enumerate(zip(targets, found.layers, strict=True)):
        if layer.verdict == HELD_BACK:
            skipped.append(_held_back(contact, layer))
        elif number in unfelt:
            skipped.append(not_served(contact, LIMITS_LEAVE_NOTHING))
        elif layer.verdict != SHARED:
            sharing = [
                (*targets[other], one)
                for other, one in enumerate(found.layers)
                if one.verdict == SHARED
                and one.excitation == layer.excitation
                and other not in unfelt
            ]
            served = [(contact, target, layer), *sharing]
            voices = [
                replace(layer, excitation=tones) for tones in (layer.excitation, *layer.side_bands)
            ]
            is_continued = all(
                (then := before.get((contact.key, voice))) is not None
                and then.frequency == each.frequency
                for voice, each in enumerate(voices)
            )
            carrier = before.get((contact.key, 0))
            for voice, each in enumerate(voices):
                pattern = _pattern(table, each, capabilities)
                pattern = pattern.scaled(change) if change else pattern
                if carrier is not None or layer.side_bands:
                    then = carrier if is_continued else None
                    pattern = _in_phase(pattern, then, fields(), number, table)
                contents.append(
                    _content(served, targets, quiet, pattern, is_continued, factor, shape, voice)
                )
    return Selection(
        tuple(targets),
        tuple(quiet),
        tuple(contents),
        None if contents else skipped[0].held_back,
        tuple(skipped),
        quiet_levels={
            contact.key: felt.level_db_sl + change
            for contact, felt in zip(quiet, found.quiet, strict=True)
        },
        protected=protected,
    )


def _as_layers_allow(requests: Sequence[Request], layers: int) -> list[Request]:
    """The requests, steady where there are no layers for side bands, of low priority first.

    A layer is left to a click.
    """
    found, spare = [*requests], layers - len(requests) - 1
    for number in sorted(range(len(found)), key=lambda each: -found[each].priority):
        if found[number].modulation_hz is not None:
            if spare >= _SIDE_BANDS:
                spare -= _SIDE_BANDS
            else:
                found[number] = replace(found[number], modulation_hz=None)
    return found


def _kept(
    requests: Sequence[Request],
    targets: Sequence[tuple[Contact, Target]],
    before: Mapping[tuple[ContactKey, int], Content],
) -> list[Request]:
    """The requests with the frequencies that fingers feel now, where their bands allow it."""
    kept = []
    for requested, (contact, _) in zip(requests, targets, strict=True):
        each = requested
        then = before.get((contact.key, 0))
        frequency = None if then is None else then.frequency
        low, high = each.band_hz
        if frequency is not None and low <= frequency <= high:
            each = replace(each, band_hz=(frequency, frequency))
        kept.append(each)
    return kept


def _answer(
    table: LocalizationTable,
    requests: Sequence[Request],
    fingers: Sequence[Finger],
    kept: Sequence[Request],
    kept_within: float,
    playable: tuple[float, float],
    mode: str,
) -> Answer:
    """Answer with the kept frequencies, or with any where that is so much better [dB]."""
    found = answer(table, kept, fingers, drive_mode=mode, playable=playable)
    worst, served = found.promised_worst_db, _served(found)
    least = OWN_CONTRAST_DB if math.isfinite(kept_within) else -math.inf
    is_good = served == len(requests) and (worst is None or worst >= least)
    if is_good or list(kept) == list(requests):
        return found
    other = answer(table, requests, fingers, drive_mode=mode, playable=playable)
    gain = _worst(other) - _worst(found)
    is_better = _served(other) > served or (_served(other) == served and gain >= kept_within)
    return other if is_better else found


def _served(found: Answer) -> int:
    return sum(layer.verdict not in (HELD_BACK, SHARED) for layer in found.layers)


def _worst(found: Answer) -> float:
    return math.inf if found.promised_worst_db is None else found.promised_worst_db


def _tones_of(layer: Layer) -> tuple[Excitation, ...]:
    """What plays of a layer; fingers that share have one."""
    return () if layer.verdict in (HELD_BACK, SHARED) else (layer.excitation, *layer.side_bands)


def _gains_db(
    requests: Sequence[Request],
    found: Answer,
    capabilities: PlaybackCapabilities,
    strokes: Mapping[str, float],
) -> list[float]:
    """Gains on the layers of an answer by which they are within the amplifiers' limits.

    As the stroke is shared: those of lower priority are lowered first, of equal ones the louder.
    Power counts in shares of what all together would have.
    """
    each_layer = [amplitudes_of(_tones_of(each)) for each in found.layers]
    amplitudes = np.array([[each[name] for name in strokes] for each in each_layer])
    levels = amplitudes / [*strokes.values()]
    norms = np.linalg.norm(levels, axis=1)
    power = norms * np.linalg.norm(levels.sum(axis=0)) / norms.sum()
    full = amplitudes / [capabilities.max_amplitudes[name] for name in strokes]
    limited = np.column_stack([full, power / math.sqrt(capabilities.max_power)])
    served = np.flatnonzero(norms).tolist()
    promised = np.array([found.layers[at].promised_level_db_sl for at in served])
    factors, _ = share_stroke(
        np.ones(len(served)),
        limited[served].astype(np.complex64),
        10 ** (promised / 20),
        [requests[at].priority for at in served],
    )
    gains = np.maximum(decibels(np.maximum(factors, 1e-9)), _SILENT_DB)
    return [
        next(
            (
                float(gain)
                for at, gain in zip(served, gains, strict=True)
                if found.layers[at].excitation == layer.excitation
            ),
            0.0,
        )
        for layer in found.layers
    ]


def _at_gain(request: Request, layer: Layer, gain_db: float) -> Request:
    """A request at the frequency of its layer, at a lower level."""
    frequency = layer.frequency
    band = request.band_hz if frequency is None else (frequency, frequency)
    level = max(MIN_LEVEL_DB_SL, request.level_db_sl + gain_db)
    return replace(request, level_db_sl=level, band_hz=band)


def _pattern(table: LocalizationTable, layer: Layer, capabilities: PlaybackCapabilities) -> Pattern:
    """A layer of an answer as a pattern; its quiet level is that which the contrast compares."""
    nominal, promised = layer.felt_contrast_db, layer.promised_contrast_db
    level, robust = layer.level_db_sl, layer.promised_level_db_sl
    return Pattern(
        layer.excitation,
        ONSET_RAMP,
        level,
        None,
        None if nominal is None else level - nominal,
        capabilities.drive_mode,
        robust_level_db_sl=robust,
        robust_quiet_level_db_sl=None if promised is None else robust - promised,
        robust_felt_contrast_db=promised,
        median_felt_contrast_db=layer.median_felt_contrast_db,
        threshold=table.threshold,
    )


def _content(
    served: Sequence[tuple[Contact, Target, Layer]],
    targets: Sequence[tuple[Contact, Target]],
    quiet: Sequence[Contact],
    pattern: Pattern,
    is_continued: bool,
    factor: float,
    shape: Shape,
    voice: int,
) -> Content:
    """A voice of the content of one finger and those that share it."""
    own = {contact.key for contact, _, _ in served}
    others = [contact for contact, _ in targets if contact.key not in own]
    first = served[0][0]
    question = question_of(
        first, [*others, *quiet], level_db_sl=pattern.level_db_sl, drive_mode=pattern.drive_mode
    )
    change = float(decibels(factor))
    predictions = tuple(
        Prediction(
            contact,
            layer.promised_level_db_sl + change,
            verdict=layer.verdict,
            held_back=None
            if layer is served[0][2]
            else f"shares the vibration of finger {first.key.source} {first.key.id}; lift one, or "
            "move them apart",
            promised_contrast_db=layer.promised_contrast_db,
            foreign_level_db_sl=_changed(layer.foreign_level_db_sl, change),
            frequency=layer.frequency,
            content=served[0][1].content,
        )
        for contact, _, layer in served
    )
    return Content(
        tuple((contact, target) for contact, target, _ in served),
        question,
        shape(question, pattern, is_continued),
        () if voice else predictions,
        voice,
    )


def _changed(level_db_sl: float | None, change_db: float) -> float | None:
    return None if level_db_sl is None else level_db_sl + change_db


def _held_back(contact: Contact, layer: Layer) -> Prediction:
    """What is said of a finger whose content is held back, and by how much."""
    had = layer.promised_contrast_db
    least = max(request.MIN_CONTRAST_DB, layer.request.min_contrast_db)
    if layer.is_disturbing:
        reason = "a protected finger would notice it; lower its level, or lift that finger"
    elif had is not None and had >= least:
        reason = (
            "too many contents for this plate: beside it another finger would not have had the "
            f"{request.MIN_CONTRAST_DB:g} dB of contrast, or more, that it requires; lift a "
            "finger, move it away, or widen its band"
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
        foreign_level_db_sl=layer.foreign_level_db_sl,
    )


def _in_phase(
    pattern: Pattern,
    before: Content | None,
    fields: Complex64Array,
    number: int,
    table: LocalizationTable,
) -> Pattern:
    """Turn a pattern so that its finger feels it in the phase of the tone before, 0 without any.

    Side bands in phase with their carrier modulate its amplitude, not its frequency: all have the
    phase of the carrier before. fields (f, eras, fingers): of each ERA at full stroke; number: of
    the finger.
    """
    fields = fields[:, :, number]
    felt = _felt(pattern.excitation, fields, table)
    felt_before = {} if before is None else _felt(before.pattern.excitation, fields, table)
    (then,) = felt_before.values() if len(felt_before) == 1 else (1.0,)
    turned = {}
    for name, tone in pattern.excitation.items():
        now = felt[tone.frequency]
        change = cmath.phase(then / now) if now and then else 0.0
        turned[name] = replace(tone, phase=tone.phase + change)
    return replace(pattern, excitation=turned)


def _felt(
    excitation: Excitation, fields: Complex64Array, table: LocalizationTable
) -> dict[float, complex]:
    """Complex acceleration at a finger, by frequency [Hz]."""
    frequencies, bases = base_amplitudes(excitation, table.eras)
    rows = table.rows_of(frequencies)
    weights = bases / [era.stroke for era in table.eras]
    felt = (weights * fields[rows]).sum(axis=1)
    return dict(zip(frequencies.tolist(), felt.tolist(), strict=True))
