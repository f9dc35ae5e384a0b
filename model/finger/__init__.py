"""A finger on the plate: contact area, load, detection thresholds and contrast."""

MAX_CONTACTS = 10
"""Ten fingers; more are a forearm, a spill or a broken panel."""
