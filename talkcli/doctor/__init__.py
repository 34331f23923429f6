"""What `talk doctor` knows: everything between a sentence and a loudspeaker, looked at in order.

Facts are gathered in `look` (files of this machine), `ask` (programs of others), `probe` (an engine process of its own)
and `reach` (the server); `session`, `voice`, `sound`, `level`, `places`, `serving` and `sentence` judge them and do no
I/O. `examine` puts all in order, and `report` makes lines. Nothing here prints, and none of it loads libespeak-ng into
this process: a library that crashes must be a finding.
"""
