"""A desk without hardware: measured, calibrated, played and verified, by real processes."""
