"""The speech server, an asyncio program with a thread for the engine.

This package does the I/O, and `goals` makes the decisions. Only `cli.services` imports the server.

    run          starts and stops the server, admits clients, and describes its status
    listener     the listening socket and its lock
    stream       sends and receives the bytes of a client
    connection   reads the requests of a client, and limits what the client may send and leave unread
    requests     handles each kind of request
    speech       connects the scheduler with the engine, and logs what happens to goals and engines
    subscribers  sends events to clients that wait or watch
    voices       finds the voices that clients ask for
"""
