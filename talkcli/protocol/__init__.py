"""The messages between client and server: lines of bytes, requests, events and replies.

Form only: nothing is decided, opened or waited for. It may import goals and the ground. A new request is a class with a
row for each of its fields, a new event or reply a frozen value with its JSON form beside it. The fields of a goal and
the settings are in `goals.options`. README.md beside this file documents the wire.
"""
