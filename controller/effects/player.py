"""Player of a surface layout: converts contacts to a haptic intent, the effect of each finger."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from operator import itemgetter

from controller.effects.effect import Effect, EffectRun, EffectStimulus, NoStimulus, Region
from controller.effects.layout import SurfaceLayout
from controller.effects.strengths import Strengths
from controller.play.intent import NO_CONTACTS, Band, HapticIntent, Pulse, Target
from controller.sources.touch import Contact, ContactKey
from model.transients.excursions import CLICKS_APART
from registry.plugins import WrongResultError

# Sensor noise must not make a finger on the edge of a region flip between regions: it stays in a
# region until it is this far [m] from the point of entry.
_NOISE = 0.001

REQUESTED_PRIORITY = 1_000_000
"""Priority of an effect requested by name, above all regions."""

CLICK_ABOVE_DB = 6.0
"""Default level [dB] of a short pulse above a continuous effect at its finger."""

NOTICED_ABOVE_DB = 3.0
"""Level [dB] above a continuous effect at which a short pulse becomes noticeable."""

# A short pulse that would wait longer [s], two turns plus rounding, is left out.
_MAX_WAIT = 2 * CLICKS_APART + 0.005


@dataclass
class _Play:
    """A run of an effect at one finger."""

    name: str
    effect: Effect
    run: EffectRun
    number: int  # in order of start
    priority: int
    band: Band | None
    region: Region | None
    is_elsewhere: bool  # whether it is the effect outside all regions
    above_db: float | None  # see `Target`
    player: str | None = None  # client that requested it

    @property
    def outlasts_its_layout(self) -> bool:
        """Whether it was requested, or is a press effect of limited duration."""
        is_press = self.effect.has_end and not self.effect.is_for_motion
        return is_press or self.priority == REQUESTED_PRIORITY


@dataclass
class _Finger:
    """The state of a finger."""

    since: float  # s; when it came down
    region: Region | None
    entered: tuple[float, float]  # m; point of entry into the region
    plays: list[_Play] = field(default_factory=list)
    ended: str = ""  # name of the effect that ended most recently


class EffectPlayer:
    """Plays the effects of a layout; times are arguments.

    Every finger feels its newest continuous play; when that ends, the previous one continues. It
    also feels its newest short pulse, by default 6 dB above the continuous play. Only the newest
    finger outside all regions feels the effect there. Short pulses of different fingers are 60 ms
    apart: the newest pulse of each finger waits for its turn, at most 0.12 s. A play without a
    current stimulus (no detent passed, no movement) does not count.
    """

    def __init__(self, layout: SurfaceLayout, strengths: Strengths | None = None) -> None:
        self.layout, self.strengths = layout, strengths or Strengths()
        self._already_pressed: dict[ContactKey, _Finger] = {}  # under another layout
        self._fingers: dict[ContactKey, _Finger] = {}
        self._number = 0
        self._last_click: tuple[ContactKey, Pulse] | None = None
        self._waiting: dict[ContactKey, Pulse] = {}  # short pulses waiting for their turn
        self._sensing = self._targets = self._felt = set[ContactKey]()  # of the latest intent

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return the stimuli of all contacts at a time [s]."""
        self._update_regions(contacts, now)
        if not contacts:
            return HapticIntent((), NO_CONTACTS)
        sensed: list[tuple[int, _Play, ContactKey, EffectStimulus]] = []
        ends, protected, newest_elsewhere = list[float](), set[ContactKey](), 0
        for contact in contacts:
            finger = self._fingers[contact.key]
            if finger.region is not None and finger.region.is_protected:
                protected.add(contact.key)
            for play, stimulus in self._current_stimuli(finger, contact, now, ends):
                sensed.append((play.number, play, contact.key, stimulus))
                if play.is_elsewhere:
                    newest_elsewhere = max(newest_elsewhere, play.number)
        sensed.sort(key=itemgetter(0))
        waiting, self._waiting, targets = self._waiting, {}, list[Target]()
        gains_db = dict[tuple[ContactKey, bool], float]()
        self._sensing, self._targets, self._felt = set(), set(), set()
        for number, play, key, stimulus in sensed:
            self._sensing.add(key)
            if play.is_elsewhere and number < newest_elsewhere:
                continue
            if len(contacts) > 1 and stimulus.among_others is not None:
                stimulus = stimulus.among_others
            target = stimulus.target(
                key,
                play.name,
                play.region,
                band=play.band,
                priority=play.priority,
                above_db=play.above_db,
            )
            targets.append(target)
            self._targets.add(key)
            gains_db[key, target.is_short] = self.strengths.gain_db(
                key.source, play.player, play.region.name if play.region else None
            )
            if key in waiting and target.is_short:
                self._waiting[key] = waiting[key]
        felt = list[Target]()
        for target in targets:
            if not self._waits(target, now, ends):
                felt.append(target)
                self._felt.add(target.key)
        return HapticIntent(
            tuple(felt),
            "" if felt else "; ".join(dict.fromkeys(map(self.why_not, self._fingers))),
            until=min(ends, default=math.inf),
            protected=frozenset(protected),
            gains_db=gains_db,
        )

    def why_not(self, key: ContactKey) -> str:
        """Return why a finger feels nothing in the latest intent; "" if it feels something."""
        finger = self._fingers.get(key)
        if finger is None or key in self._felt:
            return ""
        name = finger.plays[-1].name if finger.plays else ""
        if key in self._waiting:
            return f"{name} waits for the short effects of other fingers"
        if key in self._targets:
            return f"{name} came too soon after short effects of other fingers; touch there again"
        if key in self._sensing:
            return f"{name} is felt only by the newest finger outside all regions; lift that finger"
        if name and finger.plays[-1].effect.is_for_motion:
            return f"{name} is not felt at rest; move the finger"
        if name:
            return f"{name} pauses; it continues on its own"
        if finger.ended:
            return f"{finger.ended} ended; touch there again"
        return "no effect plays there; touch again in a region with an effect"

    def replace(self, layout: SurfaceLayout) -> None:
        """Switch to another layout; fingers already on the plate feel none of its press effects.

        Requested effects and effects of limited duration continue to their end. At these fingers,
        only motion effects and endless effects of the new layout start.
        """
        self.layout = layout
        self._already_pressed |= self._fingers
        self._fingers = {}

    def effect_of(self, key: ContactKey) -> str | None:
        """Return the name of the effect that plays at a finger, or None."""
        finger = self._fingers.get(key)
        return finger.plays[-1].name if finger and finger.plays else None

    def play(
        self,
        name: str,
        contact: Contact,
        now: float,
        *,
        level_db_sl: float | None,
        player: str | None = None,
        effect: Effect | None = None,
    ) -> None:
        """Start a named effect at a finger, in place of an earlier request of that name.

        level_db_sl: replaces the level of the effect unless None; player: client whose strength
        applies; effect: replaces the layout's effect. Raises KeyError for an unknown effect.
        """
        effect = effect or self.layout.effects[name]
        level = effect.level_db_sl if level_db_sl is None else level_db_sl
        finger = self._fingers.get(contact.key)
        if finger is None or finger.since != contact.since:
            finger = self._add(contact, now)
        # Requests must not pile up.
        finger.plays = [
            play
            for play in finger.plays
            if (play.name, play.priority) != (name, REQUESTED_PRIORITY)
        ]
        requested = REQUESTED_PRIORITY
        at = finger, finger.region, name, effect, contact, now
        self._start(*at, level=level, priority=requested)
        is_given = level_db_sl is not None or effect.gives_level_in(None)
        finger.plays[-1].above_db = None if is_given else CLICK_ABOVE_DB
        finger.plays[-1].player = player

    def _waits(self, target: Target, now: float, ends: list[float]) -> bool:
        """Whether a short pulse waits for its turn at a time [s]; if so, add its end to ends."""
        key, pulse = target.key, target.pulse
        if pulse is None or not target.is_short or pulse.started_at is not None:
            return False
        if math.isinf(pulse.due_at):
            self._line_up(key, pulse)
        if self._waiting.get(key) is not pulse:
            return math.isinf(pulse.due_at)
        if self._last_click is not None and self._last_click[0] != key:
            # It can have started later than it was due.
            pulse.due_at = max(pulse.due_at, self._last_click[1].start + CLICKS_APART)
        if now < pulse.due_at:
            ends.append(pulse.due_at)
            return True
        del self._waiting[key]
        self._last_click = key, pulse
        return False

    def _line_up(self, key: ContactKey, pulse: Pulse) -> None:
        """Schedule a short pulse in the slot of its finger's waiting pulse, or in the last slot."""
        before = self._waiting.get(key)
        if before is None:
            others = [each.due_at for each in self._waiting.values()]
            if self._last_click is not None and self._last_click[0] != key:
                others.append(self._last_click[1].start)
            due_at = max([pulse.requested_at, *(each + CLICKS_APART for each in others)])
            if due_at > pulse.requested_at + _MAX_WAIT:
                return
        else:
            due_at, before.due_at = before.due_at, -math.inf
        pulse.due_at = due_at
        self._waiting[key] = pulse

    def _update_regions(self, contacts: Sequence[Contact], now: float) -> None:
        """Start and end effects as fingers enter and leave regions."""
        since: dict[ContactKey, float] = {}
        for contact in contacts:
            since[contact.key] = contact.since
        for key, one in [*self._fingers.items()]:
            # A finger that came down again with the same id is a new one.
            if since.get(key) != one.since:
                del self._fingers[key]
        if pressed := self._already_pressed.items():
            self._already_pressed = {k: one for k, one in pressed if since.get(k) == one.since}
        for contact in contacts:
            finger = self._fingers.get(contact.key)
            if finger is None:
                self._add(contact, now)
                continue
            position = (contact.x, contact.y)
            if math.dist(position, finger.entered) < _NOISE:
                continue
            region = self.layout.region_at(*position)
            if finger.region is not region:
                left, finger.region, finger.entered = finger.region, region, position
                finger.plays = [
                    play for play in finger.plays if play.priority == REQUESTED_PRIORITY
                ]
                self._enter(finger, contact, now)
                if left is not None and left.on_release is not None:
                    self._start_in(finger, left, left.on_release, contact, now)

    def _add(self, contact: Contact, now: float) -> _Finger:
        """Add a new finger and start its effects."""
        position = (contact.x, contact.y)
        finger = _Finger(contact.since, self.layout.region_at(*position), position)
        self._fingers[contact.key] = finger
        self.strengths.note(contact.key.source)
        self._enter(finger, contact, now)
        if (before := self._already_pressed.pop(contact.key, None)) is not None:
            kept = [each for each in before.plays if each.outlasts_its_layout]
            for each in kept:  # older than the plays that start now
                self._number += 1
                each.number = self._number
            finger.plays = [each for each in finger.plays if not each.outlasts_its_layout] + kept
        return finger

    def _enter(self, finger: _Finger, contact: Contact, now: float) -> None:
        """Start the effects of the region that a finger enters, or the effect outside all."""
        region = finger.region
        # The motion effect starts first, so that the newer press effect is felt before it.
        names = (region.on_move, region.on_press) if region else (self.layout.elsewhere,)
        for name in names:
            if name is not None:
                self._start_in(finger, region, name, contact, now)

    def _start_in(
        self, finger: _Finger, region: Region | None, name: str, contact: Contact, now: float
    ) -> None:
        """Start an effect of a region, or the effect outside all."""
        level = self.layout.level_of(name, region)
        priority = 0 if region is None else region.priority
        effect = self.layout.effects[name]
        self._start(finger, region, name, effect, contact, now, level=level, priority=priority)

    def _start(
        self,
        finger: _Finger,
        region: Region | None,
        name: str,
        effect: Effect,
        contact: Contact,
        now: float,
        *,
        level: float | None,
        priority: int,
    ) -> None:
        """Start an effect in a region, or outside all."""
        self._number += 1
        run = effect.start_in(region, contact, now, level_db_sl=level)
        if not isinstance(run, EffectRun):
            raise WrongResultError(effect, run, EffectRun)
        band = effect.band_in(region)
        is_elsewhere = region is None and priority != REQUESTED_PRIORITY
        above = None if effect.gives_level_in(region) else CLICK_ABOVE_DB
        finger.plays.append(
            _Play(name, effect, run, self._number, priority, band, region, is_elsewhere, above)
        )

    def _current_stimuli(
        self, finger: _Finger, contact: Contact, now: float, ends: list[float]
    ) -> Collection[tuple[_Play, EffectStimulus]]:
        """Return the newest continuous play and the newest short pulse of a finger.

        Adds every `until` to ends. Calls all plays, because motion effects follow the finger.
        """
        felt: dict[bool, tuple[_Play, EffectStimulus]] = {}
        lasting: list[_Play] = []
        for play in finger.plays:
            result = play.run.feel(contact, now)
            if result is None:
                finger.ended = play.name
                continue
            if not isinstance(result, EffectStimulus | NoStimulus):
                raise WrongResultError(play.run, result, EffectStimulus)
            lasting.append(play)
            if result.until is not None:
                ends.append(result.until)
            if isinstance(result, EffectStimulus):
                felt[result.is_short] = play, result
                if not result.is_short and True in felt and felt[True][1].is_absolute:
                    del felt[True]  # of an earlier file
                if result.click is not None:
                    felt[True] = play, result.click
        finger.plays = lasting
        return felt.values()
