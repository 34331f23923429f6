"""The operator's side of a fleet, which sends requests to robots through the broker."""
