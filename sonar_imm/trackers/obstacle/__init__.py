"""The obstacle tracker: obstacles ahead of a vehicle, with their vertical offset."""
