"""The operator's side of a fleet: sends requests to robots, watches them, and formats their state as text."""
