"""The folder of a tracked recording: what ``track`` writes and ``evaluate`` reads.

estimate/      the estimates as a bag, topic ``/<system>/estimate``
estimate.csv   the same rows as text: stamp_ns, then the columns of the contract
run.json       where they come from; written last, so a folder without it is not a finished run
metrics.json   and report.html, once evaluated

The bag and the CSV hold nothing that depends on the time or the machine: the same command writes
the same bytes. What does depend on them is in run.json.
"""

from __future__ import annotations
