"""The plate in the time domain: excitation, contacts, and fingertip vibration."""
