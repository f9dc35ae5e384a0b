"""The founding paper: its printed numbers, and its figures reproduced."""
