"""Calibration: accuracy by noise and sensors, and intervals over hidden plates."""
