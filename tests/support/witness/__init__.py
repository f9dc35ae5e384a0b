"""The witness: checks the traffic between hosts and amplifiers."""
