"""The plate in time, what moves it, and the fingers that rest on it."""
