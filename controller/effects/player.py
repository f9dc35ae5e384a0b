"""Player of a surface layout: converts contacts to a haptic intent, the effect of each finger."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from controller.effects.effect import Effect, EffectRun, EffectStimulus, NoStimulus, Region
from controller.effects.layout import SurfaceLayout
from controller.effects.strengths import Strengths
from controller.play.intent import NO_CONTACTS, Gains, HapticIntent, Pulse, Target
from controller.sources.touch import Contact, ContactKey
from model.transients.excursions import CLICKS_APART
from registry.plugins import WrongResultError

# Sensor noise must not make a finger on the edge of a region flip between regions: it stays in a
# region until it is this far [m] from the point of entry.
_NOISE = 0.001

# A short pulse that would wait longer [s], two turns plus rounding, is left out.
_MAX_WAIT = 2 * CLICKS_APART + 0.005

REQUESTED_PRIORITY = 1_000_000
"""Priority of requested effects, above all regions, whose priority is at most 100."""

CLICK_ABOVE_DB = 6.0
"""Default level [dB] of a short pulse above a continuous effect at its finger."""

NOTICED_ABOVE_DB = 3.0
"""Level [dB] above a continuous effect at which a short pulse becomes noticeable."""


@dataclass
class Play:
    """A run of an effect at one finger."""

    name: str
    effect: Effect
    run: EffectRun
    number: int  # in order of start
    region: Region | None  # None: outside all regions
    above_db: float | None  # see `Target`
    is_requested: bool = False  # whether a client requested it by name
    player: str | None = None  # client that requested it
    targets: tuple[Target, ...] | None = None
    """Its targets in the latest intent; None before the first one."""

    @property
    def priority(self) -> int:
        """Priority of its target; see `Target`."""
        if self.is_requested:
            return REQUESTED_PRIORITY
        return 0 if self.region is None else self.region.priority

    @property
    def is_elsewhere(self) -> bool:
        """Whether it is the layout's effect outside all regions."""
        return self.region is None and not self.is_requested

    @property
    def why_paused(self) -> str:
        """Why it has no stimulus although it has not ended."""
        if self.effect.is_for_motion:
            return f"{self.name} is felt only {self.effect.motion_condition}"
        return f"{self.name} pauses; it continues on its own"

    @property
    def outlasts_its_layout(self) -> bool:
        """Whether it was requested, or is a press effect of limited duration."""
        is_press = self.effect.has_end and not self.effect.is_for_motion
        return is_press or self.is_requested


@dataclass
class _Finger:
    """The state of a finger."""

    since: float  # s; when it came down
    region: Region | None
    entered: tuple[float, float]  # m; point of entry into the region
    plays: list[Play] = field(default_factory=list)
    ended: str = ""  # name of the effect that ended most recently


class _FeltPlay(NamedTuple):
    """A play with its current stimulus."""

    key: ContactKey
    play: Play
    stimulus: EffectStimulus


class EffectPlayer:
    """Plays the effects of a layout; times are arguments.

    Every finger feels its newest continuous play; when that ends, the previous one continues. It
    also feels its newest short pulse, by default 6 dB above the continuous play. Only the newest
    finger outside all regions feels the effect there. Short pulses of different fingers are 60 ms
    apart: the newest pulse of each finger waits for its turn, at most 0.12 s. A play without a
    current stimulus (no detent passed, no movement) does not count.
    """

    def __init__(self, layout: SurfaceLayout, strengths: Strengths | None = None) -> None:
        self.layout = layout
        self.strengths = strengths or Strengths()
        self._fingers: dict[ContactKey, _Finger] = {}
        self._already_pressed: dict[ContactKey, _Finger] = {}  # under another layout
        self._play_count = 0
        self._clicks = ClickTurns()
        # Fingers of the latest intent with a stimulus, with a target, and with a target that plays.
        self._stimulated: set[ContactKey] = set()
        self._targeted: set[ContactKey] = set()
        self._served: set[ContactKey] = set()

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return the stimuli of all contacts at a time [s]."""
        self._update_regions(contacts, now)
        if not contacts:
            return HapticIntent((), NO_CONTACTS)
        changes: list[float] = []  # s; when the intent can change
        felt_plays = self._felt_plays(contacts, now, changes)
        self._stimulated = {felt.key for felt in felt_plays}
        felt_plays = _with_newest_elsewhere(felt_plays)
        is_alone = len(contacts) == 1
        targets = [_target(felt, is_alone=is_alone) for felt in felt_plays]
        self._note_targets(felt_plays, targets)
        self._targeted = {target.key for target in targets}
        self._clicks.keep({target.key for target in targets if target.is_short})
        playing = []
        for target in targets:
            start = self._start_of(target, now)
            if start > now:
                changes.append(start)
            else:
                playing.append(target)
        self._served = {target.key for target in playing}
        reasons: dict[str, None] = {}
        if not playing:
            reasons = dict.fromkeys(self.why_not(key) for key in self._fingers)
        return HapticIntent(
            tuple(playing),
            "; ".join(reasons),
            until=min(changes, default=math.inf),
            protected=self._protected(),
            gains_db=self._gains_db(felt_plays, targets),
        )

    def _note_targets(self, felt_plays: Sequence[_FeltPlay], targets: Sequence[Target]) -> None:
        """Store the targets of all plays."""
        for finger in self._fingers.values():
            for play in finger.plays:
                play.targets = ()
        for felt, target in zip(felt_plays, targets, strict=True):
            felt.play.targets = (*(felt.play.targets or ()), target)

    def is_active(self, play: Play, key: ContactKey) -> bool:
        """Whether a play at a finger has neither ended nor been replaced."""
        finger = self._fingers.get(key)
        return finger is not None and any(active is play for active in finger.plays)

    def has_effect_at(self, contact: Contact) -> bool:
        """Whether a contact that comes down here starts an effect."""
        region = self.layout.region_at(contact.x, contact.y)
        return any(self._entry_effects(region))

    def _start_of(self, target: Target, now: float) -> float:
        """Return when [s] a target starts to play; infinite for never."""
        if target.pulse is None or not target.is_short:
            return now
        return self._clicks.start_of(target.key, target.pulse, now)

    def _protected(self) -> frozenset[ContactKey]:
        """Return the fingers in protected regions."""
        protected = []
        for key, finger in self._fingers.items():
            if finger.region is not None and finger.region.is_protected:
                protected.append(key)
        return frozenset(protected)

    def _gains_db(self, felt_plays: Sequence[_FeltPlay], targets: Sequence[Target]) -> Gains:
        """Return the strengths [dB] of plays, by finger and by whether they are short pulses."""
        gains_db = {}
        for (key, play, _), target in zip(felt_plays, targets, strict=True):
            region = None if play.region is None else play.region.name
            gain_db = self.strengths.gain_db(key.source, play.player, region)
            gains_db[key, target.is_short] = gain_db
        return gains_db

    def why_not(self, key: ContactKey) -> str:
        """Return why a finger feels nothing in the latest intent; "" if it feels something."""
        finger = self._fingers.get(key)
        if finger is None or key in self._served:
            return ""
        if not finger.plays and finger.ended:
            return f"{finger.ended} ended; touch there again"
        if not finger.plays:
            return "no effect plays there; touch again in a region with an effect"
        play = finger.plays[-1]
        name = play.name
        if self._clicks.is_waiting(key):
            return f"{name} waits for the short effects of other fingers"
        if key in self._targeted:
            return f"{name} came too soon after short effects of other fingers; touch there again"
        if key in self._stimulated:
            return f"{name} is felt only by the newest finger outside all regions; lift that finger"
        return play.why_paused

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
        if finger is None or not finger.plays:
            return None
        return finger.plays[-1].name

    def play(
        self,
        name: str,
        contact: Contact,
        now: float,
        *,
        level_db_sl: float | None,
        player: str | None = None,
        effect: Effect | None = None,
    ) -> Play:
        """Start a named effect at a finger, in place of an earlier request of that name.

        level_db_sl: replaces the level of the effect unless None; player: client whose strength
        applies; effect: replaces the layout's effect. Raises KeyError for an unknown effect.
        """
        effect = effect or self.layout.effects[name]
        has_level = level_db_sl is not None or effect.gives_level_in(None)
        if level_db_sl is None:
            level_db_sl = effect.level_db_sl
        finger = self._fingers.get(contact.key)
        if finger is None or finger.since != contact.since:
            finger = self._add(contact, now)
        # Requests must not pile up.
        finger.plays = [
            play for play in finger.plays if not (play.is_requested and play.name == name)
        ]
        run = _run_of(effect, finger.region, contact, now, level_db_sl=level_db_sl)
        play = Play(
            name,
            effect,
            run,
            number=self._next_number(),
            region=finger.region,
            above_db=None if has_level else CLICK_ABOVE_DB,
            is_requested=True,
            player=player,
        )
        finger.plays.append(play)
        return play

    def _update_regions(self, contacts: Sequence[Contact], now: float) -> None:
        """Start and end effects as fingers enter and leave regions."""
        landed_at = {contact.key: contact.since for contact in contacts}
        self._fingers = _remaining(self._fingers, landed_at)
        self._already_pressed = _remaining(self._already_pressed, landed_at)
        for contact in contacts:
            finger = self._fingers.get(contact.key)
            if finger is None:
                self._add(contact, now)
            elif math.dist((contact.x, contact.y), finger.entered) >= _NOISE:
                self._move(finger, contact, now)

    def _add(self, contact: Contact, now: float) -> _Finger:
        """Add a new finger and start its effects."""
        position = (contact.x, contact.y)
        finger = _Finger(contact.since, self.layout.region_at(*position), position)
        self._fingers[contact.key] = finger
        self.strengths.note(contact.key.source)
        self._enter(finger, contact, now)
        pressed_finger = self._already_pressed.pop(contact.key, None)
        if pressed_finger is not None:
            finger.plays = [play for play in finger.plays if not play.outlasts_its_layout]
            for play in pressed_finger.plays:
                if play.outlasts_its_layout:
                    play.number = self._next_number()
                    finger.plays.append(play)
        return finger

    def _move(self, finger: _Finger, contact: Contact, now: float) -> None:
        """Start and end effects if a finger has moved to another region."""
        position = (contact.x, contact.y)
        region = self.layout.region_at(*position)
        left_region = finger.region
        if region is left_region:
            return
        finger.region = region
        finger.entered = position
        finger.plays = [play for play in finger.plays if play.is_requested]
        self._enter(finger, contact, now)
        if left_region is not None and left_region.on_release is not None:
            self._start(finger, left_region, left_region.on_release, contact, now)

    def _enter(self, finger: _Finger, contact: Contact, now: float) -> None:
        """Start the effects of the region that a finger enters, or the effect outside all."""
        for name in self._entry_effects(finger.region):
            self._start(finger, finger.region, name, contact, now)

    def _entry_effects(self, region: Region | None) -> list[str]:
        """Return the names of the effects that start in a region, or outside all, in order.

        The motion effect starts first, so that the newer press effect is felt before it.
        """
        names = [self.layout.elsewhere]
        if region is not None:
            names = [region.on_move, region.on_press]
        return [name for name in names if name is not None]

    def _start(
        self, finger: _Finger, region: Region | None, name: str, contact: Contact, now: float
    ) -> None:
        """Start an effect of a region, or the effect outside all."""
        effect = self.layout.effects[name]
        level_db_sl = self.layout.level_of(name, region)
        run = _run_of(effect, region, contact, now, level_db_sl=level_db_sl)
        above_db = None if effect.gives_level_in(region) else CLICK_ABOVE_DB
        finger.plays.append(Play(name, effect, run, self._next_number(), region, above_db))

    def _next_number(self) -> int:
        self._play_count += 1
        return self._play_count

    def _felt_plays(
        self, contacts: Sequence[Contact], now: float, changes: list[float]
    ) -> list[_FeltPlay]:
        """Return the newest continuous play and the newest short pulse of all fingers, by start.

        changes: gets the times [s] at which stimuli can change.
        """
        felt_plays: list[_FeltPlay] = []
        for contact in contacts:
            felt_plays += _felt_by(self._fingers[contact.key], contact, now, changes)
        felt_plays.sort(key=_number_of)
        return felt_plays


def _run_of(
    effect: Effect,
    region: Region | None,
    contact: Contact,
    now: float,
    *,
    level_db_sl: float | None,
) -> EffectRun:
    """Start a run of an effect in a region, or outside all; check the result of a plug-in."""
    run = effect.start_in(region, contact, now, level_db_sl=level_db_sl)
    if not isinstance(run, EffectRun):
        raise WrongResultError(effect, run, EffectRun)
    return run


def _remaining(
    fingers: Mapping[ContactKey, _Finger], landed_at: Mapping[ContactKey, float]
) -> dict[ContactKey, _Finger]:
    """Return the fingers still down; a finger that landed again with its former id is new."""
    return {key: finger for key, finger in fingers.items() if landed_at.get(key) == finger.since}


def _felt_by(
    finger: _Finger, contact: Contact, now: float, changes: list[float]
) -> Collection[_FeltPlay]:
    """Return the newest continuous play and the newest short pulse of a finger.

    Calls all plays, because motion effects follow the finger, and removes plays that have ended.
    """
    felt: dict[bool, _FeltPlay] = {}  # by whether it is a short pulse
    active: list[Play] = []
    for play in finger.plays:
        stimulus = play.run.feel(contact, now)
        if stimulus is None:
            finger.ended = play.name
            continue
        if not isinstance(stimulus, EffectStimulus | NoStimulus):
            raise WrongResultError(play.run, stimulus, EffectStimulus)
        active.append(play)
        if stimulus.until is not None:
            changes.append(stimulus.until)
        if isinstance(stimulus, NoStimulus):
            continue
        pulse = felt.get(True)
        if pulse is not None and not stimulus.is_short and pulse.stimulus.is_absolute:
            del felt[True]  # of an earlier file
        felt[stimulus.is_short] = _FeltPlay(contact.key, play, stimulus)
        if stimulus.click is not None:
            felt[True] = _FeltPlay(contact.key, play, stimulus.click)
    finger.plays = active
    return felt.values()


def _number_of(felt: _FeltPlay) -> int:
    return felt.play.number


def _with_newest_elsewhere(felt_plays: Sequence[_FeltPlay]) -> list[_FeltPlay]:
    """Leave out effects outside all regions, except the newest one."""
    newest = max([felt.play.number for felt in felt_plays if felt.play.is_elsewhere], default=0)
    return [felt for felt in felt_plays if not felt.play.is_elsewhere or felt.play.number == newest]


def _target(felt: _FeltPlay, *, is_alone: bool) -> Target:
    """Return the target of a play; is_alone: whether no other finger is on the plate."""
    key, play, stimulus = felt
    if not is_alone and stimulus.among_others is not None:
        stimulus = stimulus.among_others
    return stimulus.target(
        key,
        play.name,
        play.region,
        band=play.effect.band_in(play.region),
        priority=play.priority,
        above_db=play.above_db,
    )


class ClickTurns:
    """Assigns turns to the short pulses of all fingers; times are arguments.

    Only the newest pulse of each finger waits. A pulse without a turn, or replaced by a newer one
    while it waited, has an infinite `Pulse.due_at`.
    """

    def __init__(self) -> None:
        self._waiting: dict[ContactKey, Pulse] = {}
        self._last: tuple[ContactKey, Pulse] | None = None  # the pulse that had the latest turn

    def is_waiting(self, key: ContactKey) -> bool:
        """Whether a pulse of a finger waits."""
        return key in self._waiting

    def keep(self, keys: Collection[ContactKey]) -> None:
        """Forget the waiting pulses of all fingers but these."""
        self._waiting = {key: pulse for key, pulse in self._waiting.items() if key in keys}

    def start_of(self, key: ContactKey, pulse: Pulse, now: float) -> float:
        """Return when [s] a pulse starts; infinite for never."""
        if pulse.started_at is not None:
            return now
        if math.isinf(pulse.due_at):
            self._line_up(key, pulse)
        if self._waiting.get(key) is not pulse:
            has_had_turn = math.isfinite(pulse.due_at)
            return now if has_had_turn else math.inf
        last_start = self._last_start_of_others(key)
        # The last pulse can have started later than it was due.
        pulse.due_at = max(pulse.due_at, last_start + CLICKS_APART)
        if now >= pulse.due_at:
            del self._waiting[key]
            self._last = key, pulse
        return pulse.due_at

    def _line_up(self, key: ContactKey, pulse: Pulse) -> None:
        """Give a pulse the turn of its finger's waiting pulse, or else the last turn."""
        replaced = self._waiting.get(key)
        if replaced is not None:
            pulse.due_at = replaced.due_at
            replaced.due_at = -math.inf
        else:
            turns = [waiting.due_at for waiting in self._waiting.values()]
            last_turn = max([*turns, self._last_start_of_others(key)])
            due_at = max(pulse.requested_at, last_turn + CLICKS_APART)
            if due_at > pulse.requested_at + _MAX_WAIT:
                return
            pulse.due_at = due_at
        self._waiting[key] = pulse

    def _last_start_of_others(self, key: ContactKey) -> float:
        """Return when [s] the latest pulse started, -inf if it was at this finger."""
        if self._last is None or self._last[0] == key:
            return -math.inf
        return self._last[1].start
