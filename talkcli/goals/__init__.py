"""What a goal is, and which one is spoken when: states, texts, the queue, the history, the scheduler that decides.

Pure: no clock, no thread, no socket; the time comes in as an argument. It may import the ground alone. A rule about
goals goes here, into the module that has its noun; how it is written on the wire goes to `protocol`.
"""
