"""Output of a channel in time: sinusoids that fade, or follow an envelope."""
