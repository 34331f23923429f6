"""What makes sound of a text: libespeak-ng, its guard, its voices, its words; and pyttsx3's driver in front of it.

`base` has what a synthesizer does and may raise: a new one is a module here, and goes through
`tests/engine/test_synthesizer_contract.py`. It may import the players and the engine's own small parts. It runs in the
engine process alone, which may die of it.
"""
