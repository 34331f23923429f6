"""Goals: what a goal is, which one is spoken when, and how it ends.

Pure: no clock, no thread, no socket. The time is an argument. This package imports nothing of `talkcli` but the modules
at its top. A rule about goals goes into the module that has its noun. How a goal is written on the wire is in
`protocol`.
"""
