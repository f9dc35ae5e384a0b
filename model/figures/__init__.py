"""Pictures of plates, tables, contents, calibrations and templates, drawn with matplotlib."""
