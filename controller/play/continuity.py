"""Whether contents that were chosen earlier still serve the fingers as they are now.

Lasting contents continue while their targets and levels are the same, no contact has moved more
than 8 mm, none of several has set out, and no load has changed (loads change in steps of a factor
of 1.5 or more). A contact that lifts, or whose effect ends, does not change the others.
"""

import math
from collections.abc import Iterable
from dataclasses import replace

from controller.play.intent import Target, Targets
from controller.play.joint_answers import STRETCH
from controller.play.selected_contents import Question, Selection
from controller.sources.touch import Contact

MOVE_TOLERANCE = STRETCH
"""A contact that has moved by less [m] is still served: about the radius of a fingertip.

Bending wavelengths are at least 17 cm below 500 Hz, so the finger is still within the disc that
the pattern was chosen for. The answer for a moving finger covers this distance ahead.
"""


def is_met_by(intended: Question, chosen: Selection) -> bool:
    """Whether a selection also serves the lasting targets that are intended now."""
    requested = targets_of(intended.lasting)
    served = targets_of(chosen.targets)
    if not served or not requested <= served:
        return False
    # If a target ends, the others gain only if fingers share or are not served.
    if requested != served and not chosen.is_whole:
        return False
    if not _are_same_fingers(intended.contacts, chosen):
        return False
    for contact in intended.contacts:
        former_contact = chosen.contacts[contact.key]
        if not _feels_alike(contact, former_contact):
            return False
        if (contact.key in intended.protected) != (contact.key in chosen.protected):
            return False
        if not intended.is_alone and _has_set_out(contact, former_contact):
            return False
    return True


def _are_same_fingers(contacts: Iterable[Contact], chosen: Selection) -> bool:
    """Whether a selection has these contacts; fingers can have left a whole selection."""
    keys = {contact.key for contact in contacts}
    if not chosen.is_whole:
        return keys == chosen.contacts.keys()
    if not keys <= chosen.contacts.keys():
        return False
    for key, former_contact in chosen.contacts.items():
        if former_contact.is_hand and key not in keys:
            return False
    return True


def _feels_alike(contact: Contact, former: Contact) -> bool:
    """Whether an answer still serves a contact: near its former position, with the same load."""
    distance = math.dist((contact.x, contact.y), (former.x, former.y))
    is_as_heavy = contact.load == former.load and contact.is_surplus == former.is_surplus
    return distance <= MOVE_TOLERANCE and is_as_heavy


def _has_set_out(contact: Contact, former: Contact) -> bool:
    """Whether a contact that rested is moving now, and needs an answer for the path ahead."""
    has_moved = (contact.x, contact.y) != (former.x, former.y)
    return has_moved and contact.is_under_way and not former.is_under_way


def targets_of(targets: Targets) -> frozenset[Target]:
    """Return targets without their contacts."""
    return frozenset([finger.target for finger in targets])


def _at_any_level(targets: Targets) -> set[Target]:
    """Return targets without the values that may differ in a late choice."""
    return {
        replace(target, level_db_sl=None, pulse=None, modulation_hz=None, course=None)
        for _, target in targets
    }


def serves_late(selection: Selection, intended: Question) -> bool:
    """Whether a choice that took some time serves the fingers that are on the plate now.

    All contacts must have been present when it was made, without lifting since. Positions, levels
    and courses may have changed, since a finger that keeps moving would get nothing otherwise; the
    layout may not.
    """
    for contact in intended.contacts:
        former_contact = selection.contacts.get(contact.key)
        if former_contact is None or former_contact.since != contact.since:
            return False
    if not intended.protected <= selection.protected:
        return False
    return _at_any_level(intended.lasting) <= _at_any_level(selection.targets)
