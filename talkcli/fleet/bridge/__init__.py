"""The bridge, a process that connects a robot's server to the broker."""
