"""What makes sound of a text: libespeak-ng behind a driver of pyttsx3's interface, its guard, its voices, its words.

It may import the players and the engine's own small parts. It runs in the engine process alone, which may die of it.
"""
