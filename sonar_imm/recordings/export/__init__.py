"""For other programs: soundings as XYZ, LAS, LAZ and GeoTIFF; horizons as CSV, GeoJSON, SEG-Y."""
