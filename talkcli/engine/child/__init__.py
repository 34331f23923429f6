"""The engine process, which synthesizes the text of one goal at a time and plays the sound.

A new kind of goal, such as a sound or a stream, is a `GoalCommand` of the protocol and a source of samples here. The
source writes to a `Playback`, as a synthesizer does.
"""
