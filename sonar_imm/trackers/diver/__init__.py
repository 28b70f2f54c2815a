"""The diver tracker: divers from fixes or raw arrival times."""
