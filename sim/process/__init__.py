"""The far end as a process of its own: how it runs, what it shows, and how it ends."""
