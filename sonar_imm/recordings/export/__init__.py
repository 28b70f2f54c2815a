"""Soundings for charts and other programs: points as XYZ, LAS and LAZ, grids as GeoTIFF."""
