"""The checks of `talk doctor`: everything between a sentence and the loudspeaker.

- `voice`, `sound`, `server` and `sentence` have the checks of one subject each. Every check consists of facts, a
  function that finds them, and a `judge_…` function that turns them into findings. Judging is pure.
- `examine` runs the checks in order.
- `broker` has all checks of a robot behind an MQTT broker.
- `report` defines findings and shows them.

To add a check, add its facts and its judgement to the module of its subject, and call both in `examine`.
"""
