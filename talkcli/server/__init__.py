"""The server: asyncio around the scheduler, with a thread for the engine.

This package does the I/O. `goals` makes the decisions. Only `cli.serve` imports the server.

    run          the server as a whole: its clients, its status and its shutdown
    listener     the listening socket and its lock
    stream       sends and receives the bytes of a client
    connection   the lines of a client, its limits and its unanswered requests
    requests     carries out and answers each kind of request
    speech       carries out the scheduler's effects and passes on the engine's reports
    subscribers  sends events to clients that wait or watch
    voices       finds the voices that clients ask for
    log          log messages about goals, engines and senders
"""
