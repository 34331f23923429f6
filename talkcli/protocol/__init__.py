"""What client and server say to each other, as bytes and as objects: lines, requests, events.

Form only: nothing is decided, opened or waited for. It may import goals and the ground. A new request is a class with
a row for each of its fields, a new event or reply a frozen value with its form in JSON beside it; the fields that make
a goal, and the settings, are in `goals.options`. The wire's document is README.md, beside it.
"""
