"""The robot's side of a fleet: a process that connects the robot's server to the broker."""
