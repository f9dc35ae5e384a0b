"""Expected state and outputs of an amplifier, from the requests that it has carried out."""
