"""The engine process: it synthesizes the text of one goal at a time and plays the sound."""
