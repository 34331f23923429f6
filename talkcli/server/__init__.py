"""The server: asyncio around the scheduler, and the engine thread beside it.

It does I/O only: what happens is decided by `goals`. It may import all but fleet, doctor and cli, and only `cli.serve`
imports it. What a request does and is answered goes to `requests`, what is spoken to `speech`, who hears of what to
`subscribers`, what one client may to `connection`, how its bytes come and go to `stream`, and what is of the server as
a whole, who is there and how it ends, to `run`.
"""
