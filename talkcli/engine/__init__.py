"""The speech engine, which speaks one goal at a time.

`parent` runs in the server. It starts the engine process, sends goals to it and monitors it. `child` runs in the engine
process and contains the driver, the synthesizers and the players. The two exchange the messages in `protocol` and never
import each other. The tables in `voices`, `models` and `players` are shared with the server, `talk doctor` and the
command line.
"""
