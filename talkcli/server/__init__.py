"""The server: asyncio around the scheduler, and the engine thread beside it.

Only this package names asyncio, and only the command `serve` imports it. It does I/O: what is spoken when is decided by
the scheduler, how it is spoken by the engine.
"""
