"""One selection for all fingers, from lasting contents and pulses that were chosen separately."""

from collections.abc import Sequence

from controller.play.intent import FingerTarget, Targets
from controller.play.selected_contents import Content, FingerSensation, Selection, foreign_at
from controller.sources.touch import Contact, ContactKey
from model.table.table import LocalizationTable


def joined(
    contacts: Sequence[Contact],
    targets: Targets,
    parts: Sequence[Selection],
    skipped: tuple[FingerSensation, ...],
    reason: str,
    table: LocalizationTable,
) -> Selection:
    """Join selections that were chosen separately, with the contacts as they were then.

    reason: why there are no targets.
    """
    chosen = [part for part in parts if part.targets]
    if len(chosen) == 1 and len(chosen[0].targets) == len(targets):
        return chosen[0]
    former_contacts = dict[ContactKey, Contact]()
    contents = list[Content]()
    unserved = list[FingerSensation]()
    first_reason = None
    for part in chosen:
        former_contacts |= part.contacts
        if first_reason is None:
            first_reason = part.reason
        parts_beside = [selection for selection in chosen if selection is not part]
        restated = part.beside(parts_beside, table)
        contents += restated.contents
        unserved += restated.unserved

    former_targets = list[FingerTarget]()
    for contact, target in targets:
        former_contact = former_contacts.get(contact.key, contact)
        former_targets.append(FingerTarget(former_contact, target))
    target_keys = {finger.contact.key for finger in targets}
    quiet = list[Contact]()
    foreign_levels = dict[ContactKey, tuple[float, ...]]()
    for contact in contacts:
        foreign_levels[contact.key] = foreign_at(contact.key, chosen)
        if contact.key not in target_keys:
            quiet.append(former_contacts.get(contact.key, contact))
    return Selection(
        targets=tuple(former_targets),
        quiet=tuple(quiet),
        contents=tuple(contents),
        reason=first_reason if targets else reason,
        unserved=(*unserved, *skipped),
        foreign_levels=foreign_levels,
    )
