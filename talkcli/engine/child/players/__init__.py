"""Players, which play the samples of one sentence or write them to a file.

`base` defines the interface of a player, and `chooser` opens a player for each sentence. The names of the players are
in `talkcli.engine.players`.
"""
