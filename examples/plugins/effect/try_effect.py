"""Print the vibration that an effect gives a finger resting for two seconds.

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
course = effect.start(finger, 0.0, level_db_sl=effect.level_db_sl)
now: float | None = 0.0
while now is not None and now < 2.0:
    felt = course.feel(finger, now)
    if (
        isinstance(felt, EffectStimulus)
        and felt.pulse is not None
        and felt.pulse.started_at is None
    ):
        felt.pulse.started_at = now  # as by the amplifiers: it ends a duration later
        felt = course.feel(finger, now)
    if felt is None:
        print(f"{now:5.2f} s  over")
        break
    level = "nothing"
    if isinstance(felt, EffectStimulus):
        level = "all that can be" if felt.level_db_sl is None else f"{felt.level_db_sl:g} dB SL"
    print(f"{now:5.2f} s  {level}")
    if felt.until is not None and felt.until <= now:
        sys.exit(f"its `until` is {felt.until}, which is not after {now}: it would never go on")
    now = felt.until
