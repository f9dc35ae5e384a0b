"""The host's side of protocol 3: ledgers, lines, amplifiers, and the group that plays together."""
