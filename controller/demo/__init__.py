"""The demonstration: recorded touches in, vibration at the fingertips out."""
