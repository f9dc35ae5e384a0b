"""Answers: what fingers are to feel, what is played for it, and what each gets."""
