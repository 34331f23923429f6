"""The players: each takes the samples of one sentence, and plays them or writes them to a file.

`base` defines what a player does, and `chooser` opens one for each sentence. The names of the players are in
`talkcli.engine.players`.
"""
