"""What takes the samples of a sentence: programs at the end of a pipe, files, silence; and which of them is tried.

`base` has what each of them does and may raise; `which` chooses one for each sentence. It may import the ground and
the engine's own small parts. A player that is a program is a row of `programs`, any other a module here too, and each
goes through `tests/engine/test_player_contract.py`.
"""
