"""The engine: the supervisor, a thread in the server that owns one engine process, and what runs inside that process.

It may import what is below the server: the client's way to wait, daemon, protocol, goals, the ground. It knows no queue
and no client. What plays goes to `players`, what speaks to `synthesizers`, what watches over the process to
`supervisor`; only here pyttsx3 is named.
"""
