"""What most functions take first, and what makes one, for whoever hands over another thing."""

from model.arguments import expect
from model.rig.rig import Rig


def expect_rig(value: object) -> None:
    """Raise InputError for what is no rig, the name of its file say."""
    expect(value, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
