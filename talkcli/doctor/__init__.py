"""The checks of `talk doctor`, which find out why speech can't be heard.

- `voice`, `sound`, `server` and `sentence` have the checks of one subject each. A `check_…` function looks at the
  machine and returns findings. If several checks need the same facts, a `find_…` function gathers the facts, and
  `judge_…` functions turn them into findings.
- `examine` runs the checks in order.
- `broker` has all checks of a robot behind an MQTT broker.
- `report` defines findings and shows them.

To add a check, add a function to the module of its subject, and call it in `examine`.
"""
