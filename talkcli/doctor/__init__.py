"""The checks of `talk doctor`, which find out why speech can't be heard.

- `voice`, `sound`, `server` and `sentence` have the checks of one subject each. A check gathers facts, and a pure
  `judge_…` function turns the facts into findings.
- `examine` runs the checks in order.
- `broker` has all checks of a robot behind an MQTT broker.
- `report` defines findings and shows them.

To add a check, add its facts and its judgement to the module of its subject, and call both in `examine`.
"""
