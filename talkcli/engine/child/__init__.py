"""The engine process, which synthesizes the text of one goal at a time and plays the sound.

A new kind of goal, such as a sound or a stream, needs a `GoalCommand` in the protocol and a source of samples here.
Like a synthesizer, the source writes to a `Playback`.
"""
