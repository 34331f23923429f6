"""The robot's side of a fleet: a process beside the server that connects it to the broker."""
