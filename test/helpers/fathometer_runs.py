"""Running the fathometer tracker over measurements."""

from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker


def run(measurements, **parameters):
    tracker = FathometerTracker(FathometerConfig(**parameters))
    found = {}
    for one in measurements:
        found.update((each.stamp_ns, each) for each in tracker.process(one))
    return tracker, found
