"""Check of the rig that most functions take."""

from model.arguments import expect
from model.rig.rig import Rig


def expect_rig(value: object) -> None:
    """Raise InputError for anything but a rig, such as the name of its file."""
    expect(value, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
