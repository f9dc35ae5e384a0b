"""The far end: simulated amplifiers on real wires over a plate that vibrates in time."""
