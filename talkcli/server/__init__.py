"""The server: asyncio around the scheduler, with the engine thread beside it.

It only does I/O. `goals` decides what happens. Only `cli.serve` imports it.

    run          the server as a whole: its clients, its status and its end
    listener     the listening socket and its lock
    stream       the bytes of a client
    connection   the lines of a client, its limits, and its requests in progress
    requests     what each request does and how it is answered
    speech       carries out the scheduler's effects and passes on the engine's reports
    subscribers  the events for clients that wait or watch
    voices       the voices that there are
    log          the lines of the log about goals, engines and senders
"""
