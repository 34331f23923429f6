"""The operator's side of a fleet, which sends requests to robots and shows their state."""
