"""What a channel plays, described in time: sinusoids that fade, or follow an envelope."""
