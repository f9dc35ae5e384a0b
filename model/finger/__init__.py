"""A finger on the plate: contact area, load, detection thresholds and contrast."""

MAX_CONTACTS = 20
"""Two people with ten fingers each, or four with five; more are a forearm or a spill."""

MAX_CONTENTS = 6
"""Contents at the same time; more have no contrast left on any plate."""
