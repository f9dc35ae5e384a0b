"""The host's side of protocol 4: ledgers, lines, amplifiers, and the group that plays together."""
