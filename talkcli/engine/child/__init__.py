"""The engine process, which synthesizes the text of one goal at a time and plays the sound.

To support a new kind of goal, such as a sound or a stream, add a `GoalCommand` to the protocol and a source of samples
here. Like a synthesizer, the source writes to a `Playback`.
"""
