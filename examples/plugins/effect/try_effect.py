"""Print how an effect vibrates at a finger that rests for two seconds.

python try_effect.py KIND
"""

import sys

import era_haptics as era
from era_haptics.plugins.effects import Contact, ContactKey, EffectStimulus, effect_kind

if len(sys.argv) != 2:
    sys.exit(__doc__)
try:
    effect = effect_kind(sys.argv[1])()
except era.InputError as error:
    sys.exit(f"error: {error}")
finger = Contact(ContactKey("try", 1), x=0.1, y=0.1, since=0.0)
run = effect.start(finger, 0.0, level_db_sl=effect.level_db_sl)
now: float | None = 0.0
while now is not None and now < 2.0:
    stimulus = run.feel(finger, now)
    if isinstance(stimulus, EffectStimulus):
        pulse = stimulus.pulse
        if pulse is not None and pulse.started_at is None:
            pulse.started_at = now  # like the daemon when the amplifiers start
            stimulus = run.feel(finger, now)
    if stimulus is None:
        print(f"{now:5.2f} s  ended")
        break
    level = "nothing"
    if isinstance(stimulus, EffectStimulus):
        level_db_sl = stimulus.level_db_sl
        level = "highest possible level" if level_db_sl is None else f"{level_db_sl:g} dB SL"
    print(f"{now:5.2f} s  {level}")
    if stimulus.until is not None and stimulus.until <= now:
        sys.exit(f"`until` must be after {now:g} s, got {stimulus.until:g} s")
    now = stimulus.until
