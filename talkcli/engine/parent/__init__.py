"""The engine thread of the server, which starts, monitors and replaces the engine process and sends goals to it."""
