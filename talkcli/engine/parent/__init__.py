"""The engine thread of the server, which starts, feeds, monitors and replaces the engine process."""
