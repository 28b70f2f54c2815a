"""Runs of recordings: tracked offline, scored against truth, shown in a report, timed."""

SECOND = 10**9
"""Nanoseconds, the unit of every stamp."""
