"""The bathymetry tracker: the sea floor from side-scan array snapshots."""
