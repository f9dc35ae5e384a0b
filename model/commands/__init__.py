"""The model's commands of `era`: arguments parsed, answers printed."""
