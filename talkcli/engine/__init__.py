"""The engine: one thread in the server that owns one engine process, and what runs inside that process.

Only this package names pyttsx3, and only in the process: `thread` and `protocol` are the server's side of it.
"""
