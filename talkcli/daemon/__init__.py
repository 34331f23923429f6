"""The log of a long-running process, and its notifications for the service manager.

This package knows nothing about goals, clients or engines. `talkcli.server.log` has the server's log lines about those.
"""
