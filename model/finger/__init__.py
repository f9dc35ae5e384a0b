"""A finger on the plate: contact area, load, detection thresholds and contrast."""
