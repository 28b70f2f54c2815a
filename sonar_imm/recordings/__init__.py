"""Recordings: bags in and out, conversion of other formats, replay order."""
