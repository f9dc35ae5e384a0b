"""Vibration at the skin on plates within the tolerances, compared with promises."""
