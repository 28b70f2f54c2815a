"""Recordings: bags in and out, in replay order; `convert` reads other formats."""
