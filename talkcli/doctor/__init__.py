"""What `talk doctor` knows: everything between a sentence and a loudspeaker, looked at in order.

Some modules gather facts, the others judge them and are pure. It may import all but the cli, and the engine only where
it needs one. A new check is a fact, what it means, and its place in `examine`.
"""
