"""The plate in the time domain: excitation, contacts, and what fingers feel."""
