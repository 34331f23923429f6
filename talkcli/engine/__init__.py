"""The engine, which speaks the goals, one at a time.

`parent` runs in the server: it starts the engine process, sends it goals and watches it. `child` runs in the engine
process: the driver, the synthesizers and the players. They exchange the messages in `protocol` and import nothing of
each other. The other modules here are tables for both, and for the server, doctor and the commands: `voices`, `models`
and `players`.
"""
