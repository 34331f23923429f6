"""Synthesizers, which turn text into sound with libespeak-ng or with Piper's neural voices.

`base` defines the interface of a synthesizer. If the library of a synthesizer crashes, only the engine process is lost.
The names of the synthesizers are in `talkcli.engine.voices`.
"""
