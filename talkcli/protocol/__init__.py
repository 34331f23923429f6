"""The messages that clients and servers exchange: requests, replies and events.

This package only defines the form of messages. It decides nothing, opens nothing and waits for nothing. It may import
`goals` and the flat modules of `talkcli`. A new request is a class with a row for each of its fields. A new event or
reply is a frozen value with a method for its JSON form. The fields of a goal and the settings are in `goals.options`.
README.md beside this file documents the wire.
"""
