"""The client library: it connects to a server, sends requests, and returns goals as handles with their events.

It blocks, and any number of threads may use it. Every start of a command pays for it, so it imports neither click nor
asyncio nor anything heavy. It may import protocol, goals and the ground, and from terminal the functions that make
foreign text safe to show. Requests are methods of `client`, operations on one goal methods of `goal`. `core` has the
client's side of the protocol without I/O. Another transport is another subclass of `Connection` in `connection`.
"""
