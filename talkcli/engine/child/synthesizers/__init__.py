"""The synthesizers: libespeak-ng, and neural voices of Piper.

`base` defines what a synthesizer does. A crash of a synthesizer's library costs the engine process and no more. The
names of the synthesizers are in `talkcli.engine.voices`.
"""
