"""The operator's side of a fleet: it sends requests to one or more robots through the broker."""
