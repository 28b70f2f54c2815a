"""Runs of recordings: tracked offline, scored against truth, shown in a report, timed."""
