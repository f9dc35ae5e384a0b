"""Content that people have: files of other programs, read into one form and made stimuli of."""
