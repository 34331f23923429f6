"""The engine thread of the server, which starts the engine process, sends it goals, watches it and replaces it."""
