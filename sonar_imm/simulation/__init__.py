"""Scenes to test trackers on: truth and the measurements it causes, the same for the same seed."""
