"""The localization table: how it is built, kept, asked, summed up and checked."""
