"""The localization table: building, files, queries, summary and verification."""
