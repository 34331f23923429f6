"""The server's side of the engine: it starts the engine process, sends it goals, watches it and replaces it."""
