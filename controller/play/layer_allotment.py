"""Which targets get one of the amplifiers' layers, if there are more targets than layers."""

from collections import Counter
from collections.abc import Sequence

from controller.play.intent import FingerTarget, HapticIntent, Targets
from controller.play.selected_contents import FingerSensation, no_layer_free, not_served
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import Contact
from model.answer.plan import MAX_SEPARATE
from model.drive_modes import UNRESTRICTED


def targets_on_plate(contacts: Sequence[Contact], intent: HapticIntent) -> Targets:
    """Return the targets of an intent with their contacts, in order of arrival."""
    targets = list[FingerTarget]()
    for contact in contacts:
        for target in intent.targets:
            if target.key == contact.key:
                targets.append(FingerTarget(contact, target))
    return tuple(targets)


def within_layers(
    targets: Targets, capabilities: PlaybackCapabilities
) -> tuple[Targets, tuple[FingerSensation, ...]]:
    """Split targets into targets with a layer, and sensations of fingers that feel nothing.

    Short pulses of fingers with a lasting content are left out first, then the targets of lowest
    priority, the earliest first. Many targets that may share have one layer together.
    """
    mode = capabilities.drive_mode
    has_layers = mode == UNRESTRICTED
    layer_count = 1
    reason = f"the drive mode {mode} plays only one content; lift a finger"
    if has_layers:
        layer_count = capabilities.layers
        reason = no_layer_free(layer_count)
    if len(targets) <= layer_count:
        return targets, ()
    group_sizes = Counter([finger.target.shared_as for finger in targets])
    layer_groups = list[str | bool | None]()  # of each layer, what its targets share
    served_numbers = set[int]()
    for number in _by_rank(targets):
        group = targets[number].target.shared_as
        is_joint = has_layers and group is not None and group_sizes[group] > MAX_SEPARATE
        if is_joint and group in layer_groups:
            served_numbers.add(number)
        elif len(layer_groups) < layer_count:
            layer_groups.append(group)
            served_numbers.add(number)
    served = list[FingerTarget]()
    skipped = list[FingerSensation]()
    for number, finger in enumerate(targets):
        if number in served_numbers:
            served.append(finger)
        else:
            skipped.append(not_served(finger.contact, reason))
    return tuple(served), tuple(skipped)


def _by_rank(targets: Targets) -> list[int]:
    """Return the numbers of targets, in the order in which they get a layer."""
    lasting_keys = {finger.target.key for finger in targets if not finger.target.is_short}
    ranks = list[tuple[bool, int, int]]()
    for number, finger in enumerate(targets):
        target = finger.target
        is_extra = target.is_short and target.key in lasting_keys
        ranks.append((not is_extra, target.priority, number))
    return [number for _, _, number in sorted(ranks, reverse=True)]
