"""The engine thread of the server, which manages the engine process."""
