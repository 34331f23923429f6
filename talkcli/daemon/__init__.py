"""What a process that runs for months needs: its log, and signs of life for who started it.

It may import terminal, protocol, goals and the ground. It knows no goal, no client and no engine: what the server's log
says of those is in `talkcli.server.log`. A command that ends by itself has no use for it.
"""
