"""The far end, of era-haptics: simulated amplifiers on real wires over a plate that vibrates."""
