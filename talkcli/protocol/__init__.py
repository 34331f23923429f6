"""What client and server say to each other, as bytes and as objects: lines, events, replies.

Form only: nothing is decided, opened or waited for. It may import goals and the ground. A new event or reply is a
frozen value here, with its form in JSON beside it; a request is one in `goals.requests`, as its fields are a goal's.
"""
