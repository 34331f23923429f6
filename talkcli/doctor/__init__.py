"""What `talk doctor` knows: everything between a sentence and a loudspeaker, looked at in order.

`machine`, `voice`, `neural`, `sound`, `server` and `sentence` each have one subject: its facts as frozen values, who
gathers them, and what they mean. A judgement is pure: facts go in, findings come out. A new check is a fact and what it
means, in the module of its subject, and its place in `examine`. `broker` has both for a robot of a fleet, whose name is
given. It may import all but `talkcli.server` and the cli.
"""
