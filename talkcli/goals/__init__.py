"""Goals: what a goal is, when it is spoken, and how it ends.

These modules are pure. They use no clock, thread or socket, and get the time as an argument. From `talkcli` they import
only each other and the modules directly in `talkcli/`. A rule about goals belongs in the module named after its
subject. The messages in which goals travel are in `protocol`.
"""
