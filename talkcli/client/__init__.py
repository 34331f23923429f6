"""The client library, which connects to a server, sends requests and follows goals.

`client` has the blocking client, and `goal` the handle of a single goal. `calls` has the requests as coroutines, which
the blocking and the asyncio client share. `core` implements the client's side of the protocol without I/O. `connection`
has the blocking transports, and `connect` finds the server's socket. A new blocking transport is a new subclass of
`Connection`.

Calls block, and any number of threads may use a client. Every command imports this package when it starts, so it must
not import click, asyncio or anything else that is slow to import. It may import `protocol`, `goals`, the ground, and
the functions of `terminal` that make foreign text safe to show.
"""
