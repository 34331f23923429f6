"""Logging and service manager notifications for a long-running process.

This package knows nothing about goals, clients or engines. `talkcli.server.speech` logs what happens to them.
"""
