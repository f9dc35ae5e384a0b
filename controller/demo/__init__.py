"""The demonstration: recorded touches in, what each fingertip felt out, over a real wire."""
