"""A plate that stays known while the daemon drives it: readings, their estimator, its answers."""
