"""The engine speaks the goals, one at a time.

`parent` runs in the server: it starts the engine process, sends it goals and watches it. `child` runs in the engine
process: the driver, the players and the synthesizers. They exchange the messages in `protocol`. The engine may import
the layers below the client.
"""
