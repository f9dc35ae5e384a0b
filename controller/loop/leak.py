"""What fingers feel of the contents of others where they are now, since weights follow them late.

Weights are those of the places at the last answer: until a finger has moved by 8 mm, and while the
next answer is computed and fades in, what leaks to it grows.
"""

import math
from collections.abc import Sequence

import numpy as np

from controller.loop.content import Content
from controller.sources.contacts import Contact, ContactKey
from model.finger.fingertip import fingertip_points
from model.finger.perception import detection_threshold
from model.table.table import LocalizationTable


def leaks_db_sl(
    table: LocalizationTable, contents: Sequence[Content], contacts: Sequence[Contact]
) -> dict[ContactKey, float]:
    """Return what each contact feels of contents that are not for it, at its loudest point [dB SL].

    On the nominal plate with the contacts where they are; a few milliseconds.
    """
    if not contacts:  # lifted, while what plays is not known to have ended
        return {}
    places = [(each.x, each.y) for each in contacts]
    loads = [each.load for each in contacts]
    points = [fingertip_points(*at, table.plate) for at in places]
    ends = np.cumsum([len(each) for each in points])[:-1]
    power = {each.key: np.zeros(len(own)) for each, own in zip(contacts, points, strict=True)}
    fields = table.unit_fields(np.concatenate(points), contacts=places, loads=loads)
    for content in contents:
        frequencies, felt = table.driven(content.pattern.excitation, fields)
        sensed = np.abs(felt) / detection_threshold(frequencies, table.threshold)[:, None]
        own = {contact.key for contact, _ in content.targets}
        for each, part in zip(contacts, np.split((sensed**2).sum(axis=0), ends), strict=True):
            if each.key not in own:
                power[each.key] += part
    return {
        key: 10 * math.log10(each.max()) if each.any() else -math.inf for key, each in power.items()
    }
