"""The founding paper: what it prints, and its figures as they come out here."""
