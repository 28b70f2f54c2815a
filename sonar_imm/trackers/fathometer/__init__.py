"""The fathometer tracker: sub-bottom reflectors from array noise or traces."""
