# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The k best hypotheses of the diver tracker: their weights against a full enumeration, the names
of divers side by side, state files, and limits."""

from itertools import product
import math

from attrs import evolve
from helpers.diver_runs import run, SECOND
from helpers.estimates import same
from helpers.tracked import resumed
import numpy as np
import pytest

from sonar_imm.estimation import hypotheses as rules
from sonar_imm.measurements import Fix, Fixes, Start
from sonar_imm.trackers.diver import jipda, kbest
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate


def scan(second, *places, std=0.5):
    position = np.array([[x, y, 0.0] for x, y in places]).reshape(-1, 3)
    return Fixes(
        stamp_ns=round(second * SECOND),
        position=position,
        covariance=np.tile(std**2 * np.eye(2), (len(position), 1, 1)),
        frame_id='map',
    )


# -- exact ----------------------------------------------------------------------------------------

LINEAR = DiverConfig(
    model_set='linear',
    association='kbest',
    adaptation='fixed',
    acceleration_noise=(0.2,),
    detection_probability=0.7,
    clutter_density=3e-3,
    birth_density=1e-3,
    gate_probability=0.9999999,
    hypotheses=1000,
)


def gaussian(nu, S):
    return math.exp(-0.5 * nu @ np.linalg.solve(S, nu)) / (2 * math.pi * np.linalg.det(S) ** 0.5)


def enumerated(tracks, scans, config, motion, newborn):
    """Every history of pairings, (weight, {track: (x, P, r)}), by Bayes, no two merged. tracks:
    {track: (x, P, r)} at second 0; scans: {second: places}; motion: F and Q of a second."""
    F, Q = motion
    H, R = np.eye(2, 4), 0.25 * np.eye(2)
    p, false, new = (
        config.detection_probability,
        config.clutter_density,
        config.birth_density,
    )
    before = [(1.0, tracks)]
    for second, places in scans.items():
        after = []
        for weight, there in before:
            there = {
                name: (F @ x, F @ P @ F.T + Q, r * math.exp(-1.0 / config.survival_time))
                for name, (x, P, r) in there.items()
            }
            for chosen in product(range(-1, len(places)), repeat=len(there)):
                taken = [d for d in chosen if d >= 0]
                if len(set(taken)) < len(taken):
                    continue
                now, factor = {}, weight
                for (name, (x, P, r)), d in zip(there.items(), chosen):
                    if d < 0:
                        factor *= 1.0 - r * p
                        now[name] = (x, P, r * (1.0 - p) / (1.0 - r * p))
                        continue
                    S = H @ P @ H.T + R
                    nu = np.array(places[d]) - H @ x
                    K = P @ H.T @ np.linalg.inv(S)
                    factor *= r * p * gaussian(nu, S)
                    now[name] = (x + K @ nu, (np.eye(4) - K @ H) @ P, 1.0)
                for d in set(range(len(places))) - set(taken):
                    factor *= false + new
                    now[second, d] = (*newborn(places[d], R), new / (false + new))
                after.append((factor, now))
        total = sum(weight for weight, _ in after)
        before = [(weight / total, now) for weight, now in after]
    return before


def test_weights_are_those_of_all_histories(monkeypatch):
    """Two divers, three scans, a false fix, divers missed: every history by Bayes."""
    for module, name, value in (
        (kbest, 'CLAIMED', 2.0),
        (kbest, 'NOBODY_THERE', 0.0),
        (kbest, 'ROWS_OF_A_TRACK', 1000),
        (jipda, 'ENDS', 0.0),
        (rules, 'SPAN', math.inf),
    ):
        monkeypatch.setattr(module, name, value)
    tracker = DiverTracker(LINEAR)
    for x in (0.0, 1.2):
        start = Start(stamp_ns=SECOND, position=[x, 0.0, 0.0], covariance=0.01 * np.eye(2))
        tracker.process(start)
    state = tracker._stream.state
    # What is believed of a start is said of the first scan after it.
    existence = jipda.CONFIRMS * math.exp(1.0 / LINEAR.survival_time)
    tracks = {
        int(name): (x[0], P[0], existence)
        for name, x, P in zip(state.life.track_id, state.x, state.P)
    }
    assert list(tracks) == [1, 2]
    motion = tracker.models.motion(1.0)

    def newborn(place, R):
        x, P, _ = tracker.models.new_tracks(np.array([place]), R[None])
        return x[0, 0], P[0, 0]

    scans = {
        2: [(0.4, 0.3), (1.0, -0.4)],
        3: [(0.7, 0.6)],
        4: [(0.9, 0.5)],
    }
    exact = enumerated(tracks, scans, LINEAR, (motion.F[0], motion.Q[0]), newborn)
    assert len(exact) > 100
    for second, places in scans.items():
        tracker.process(scan(second, *places))
    state = tracker._stream.state
    now = state.hypotheses
    joint = [1.0]
    for cluster in np.unique(now.cluster):
        joint = [a * b for a in joint for b in now.weight[now.cluster == cluster]]
    assert sorted(joint, reverse=True) == pytest.approx(
        sorted((weight for weight, _ in exact), reverse=True), abs=1e-9
    )
    marginal = now.marginal()
    for name in (1, 2):
        rows = state.life.track_id == name
        there = (marginal * state.existence)[rows].sum()
        mean = (marginal * state.existence) @ (state.x[:, 0] * rows[:, None])
        assert there == pytest.approx(sum(w * each[name][2] for w, each in exact), abs=1e-8)
        by_bayes = sum(w * each[name][2] * each[name][0] for w, each in exact)
        assert mean == pytest.approx(by_bayes, abs=1e-8)
    # Something is uncertain, or this says little.
    assert max(joint) < 0.7


def test_few_hypotheses_are_the_likeliest_of_many():
    trackers = {}
    for count in (3, 300):
        config = DiverConfig(model_set='linear', association='kbest', hypotheses=count)
        trackers[count] = DiverTracker(config)
        for second in range(1, 6):
            trackers[count].process(scan(second, (0.0, 0.4 * second), (1.0, 0.4 * second)))
    few = trackers[3]._stream.state.hypotheses
    assert np.bincount(few.cluster).max() <= 3
    first, other = (trackers[count].process(scan(6, (0.0, 2.4), (1.0, 2.4))) for count in (3, 300))
    assert len(first[-1]) == len(other[-1]) == 2
    assert first[-1].state == pytest.approx(other[-1].state, abs=0.05)


# -- what it is for -------------------------------------------------------------------------------


def buddies(config, seed, seconds=80):
    """All estimates while two divers swim side by side 2 m apart, of whom the first is heard by
    name."""
    rng, tracker, made = np.random.default_rng(seed), DiverTracker(config), []
    for second in range(1, seconds):
        places = np.array([[0.7 * second, 0.0], [0.7 * second, 2.0]])
        seen = places[rng.uniform(size=2) < 0.9]
        false = rng.uniform(-60, 60, (rng.poisson(2.0), 2))
        fixes = np.vstack([seen + rng.normal(scale=0.5, size=seen.shape), false])
        made += tracker.process(scan(second, *fixes))
        if second > 20 and second % 4 == 0:
            x, y = places[0] + rng.normal(scale=2.0, size=2)
            made += tracker.process(
                Fix(
                    stamp_ns=round((second + 0.3) * SECOND),
                    position=[x, y, 0.0],
                    covariance=4.0 * np.eye(2),
                    target_id=7,
                    frame_id='map',
                )
            )
    return made


@pytest.mark.parametrize('seed', range(3))
def test_the_name_of_one_of_two_buddies_makes_no_third_track(seed):
    config = DiverConfig(
        model_set='heading_speed', association='kbest', clutter_density=2.0 / 120.0**2
    )
    made = buddies(config, seed)
    late = made[len(made) // 2 :]
    firm = [each.extras['track_id'][each.extras['track_state'] > 0] for each in late]
    assert len(set(np.concatenate(firm).tolist())) == 2
    named = [each.extras['target_id'].tolist() for each in late]
    assert all(each.count(7) <= 1 for each in named)
    assert np.mean([7 in each for each in named]) > 0.9
    # In the end it is on the right one.
    row = named[-1].index(7)
    assert abs(late[-1].state[row, 1]) < 1.0


def test_names_that_are_alone_take_no_nameless_fix():
    config = DiverConfig(model_set='linear', association='kbest', named_tracks='alone')
    made = buddies(config, 0, 60)
    named = made[-1].extras['target_id'] == 7
    assert named.sum() == 1 and (~named).sum() >= 2


def test_a_diver_who_is_found_late_and_lost_again():
    tracker = DiverTracker(DiverConfig(model_set='heading_speed', association='kbest'))
    made = [tracker.process(scan(t))[-1] for t in range(1, 5)]
    made += [tracker.process(scan(t, (0.5 * t, 0.0)))[-1] for t in range(5, 20)]
    made += [tracker.process(scan(t))[-1] for t in range(20, 32)]
    counts = [int((each.extras['track_state'] > 0).sum()) for each in made]
    assert counts[:6] == [0] * 6 and counts[10:19] == [1] * 9 and counts[-1] == 0
    assert len(made[-1]) == 0 and len(tracker._stream.state.life) == 0


# -- the house ------------------------------------------------------------------------------------


def crossing(seed=3, duration=40.0):
    scene = simulate(scenario('crossing', {'duration': duration}), seed)
    return [item.measurement for item in scene.measurements]


CROSSING = DiverConfig(
    model_set='heading_speed', association='kbest', clutter_density=10 / 160.0**2
)


@pytest.mark.parametrize(
    'model_set, density', [('heading_speed', 10 / 160.0**2), ('families', 0.0)]
)
def test_shuffled_scans_give_the_bits_of_sorted_ones(model_set, density):
    config = DiverConfig(
        model_set=model_set, association='kbest', clutter_density=density, history=20.0
    )
    scans = crossing(duration=15.0)
    late = [scans[k] for k in (0, 2, 1, 5, 4, 3, *range(6, len(scans)))]
    for estimate, other in zip(run(DiverTracker(config), scans), run(DiverTracker(config), late)):
        assert same(estimate, other)


@pytest.mark.parametrize('density', [10 / 160.0**2, 0.0])
def test_a_tracker_goes_on_from_its_state(tmp_path, density):
    scans, config = crossing(), evolve(CROSSING, clutter_density=density)
    tracker = DiverTracker(config)
    for item in scans[:25]:
        tracker.process(item)
    assert len(tracker._stream.state.hypotheses.cluster) > 4
    again = resumed(tmp_path / 'state', tracker, 'diver')
    for item in scans[25:]:
        first, other = tracker.process(item), again.process(item)
        assert len(first) == len(other) and all(map(same, first, other))


def test_reset_is_a_fresh_tracker():
    tracker, scans = DiverTracker(CROSSING), crossing(duration=12.0)
    first = run(tracker, scans)
    tracker.reset()
    assert all(map(same, first, run(tracker, scans)))


def errors_of(made, ids, truth):
    """RMSE of tracks, each against the path nearest to it in the end, from the tenth scan on."""
    paths, squared = np.array([path.position[:, :2] for path in truth]), []
    for number in ids:
        rows = [each.state[each.extras['track_id'] == number, :2] for each in made]
        apart = np.linalg.norm(paths[:, len(made) - 1] - rows[-1], axis=1)
        own = paths[apart.argmin()]
        squared += [
            np.sum((row - own[k]) ** 2) for k, row in enumerate(rows) if k > 9 and len(row)
        ]
    return np.sqrt(np.mean(squared))


def knot(second, rng, count):
    """Many fixes on one spot, some of them twice."""
    places = rng.normal(scale=0.3, size=(count, 2))
    return scan(second, *places, *places[: count // 2])


def test_a_knot_of_fixes_costs_bounded_memory():
    config = DiverConfig(model_set='linear', association='kbest', max_tracks=4)
    tracker, rng = DiverTracker(config), np.random.default_rng(2)
    most = kbest.most_tracks(config)
    for second in range(1, 9):
        made = tracker.process(knot(second, rng, 40 if second % 3 else 400))
        state = tracker._stream.state
        assert len(state.life) <= most * (kbest.ROWS_OF_A_TRACK + 1)
        assert len(np.unique(state.life.track_id)) <= most
        assert np.bincount(state.hypotheses.cluster).max() <= config.hypotheses
        assert np.isfinite(made[-1].state).all()
        assert (made[-1].extras['track_state'] > 0).sum() <= config.max_tracks
        assert len(set(made[-1].extras['track_id'].tolist())) == len(made[-1])


def test_nobody_is_there_with_a_probability_of_no_rows():
    nobody = DiverTracker(CROSSING)._stream.state
    assert kbest.presence(nobody).shape == (0,) and kbest.presence(nobody).dtype == float


def test_every_row_is_in_a_hypothesis_and_weights_sum_to_one():
    tracker = DiverTracker(CROSSING)
    for item in crossing():
        tracker.process(item)
        state = tracker._stream.state
        now = state.hypotheses
        assert now.member.shape[1] == len(state.life) and now.member.any(axis=0).all()
        assert np.bincount(now.cluster, now.weight) == pytest.approx(1.0, abs=1e-9)
        assert (np.bincount(now.cluster, now.shown) == 1).all()
        for row in now.member:
            assert len(set(state.life.track_id[row].tolist())) == row.sum()
        # A track is in one cluster only.
        for track in set(state.life.track_id.tolist()):
            holds = now.member[:, state.life.track_id == track].any(axis=1)
            assert len(set(now.cluster[holds].tolist())) == 1


def test_arrivals_are_paired_as_ever():
    scene = simulate(scenario('multistatic', {'duration': 20.0}), 1)
    pings = [item.measurement for item in scene.measurements]
    first, other = (
        run(DiverTracker(DiverConfig(association=name, max_tracks=1)), pings)
        for name in ('gnn', 'kbest')
    )
    for a, b in zip(first, other):
        assert a.state == pytest.approx(b.state, abs=1e-9)


def test_a_start_among_hypotheses():
    tracker = DiverTracker(CROSSING)
    scans = crossing(duration=20.0)
    for item in scans[:10]:
        tracker.process(item)
    before = len(tracker.process(scans[10])[-1])
    start = Start(
        stamp_ns=scans[10].stamp_ns + 1,
        position=[70.0, 70.0, 0.0],
        covariance=np.eye(2),
        frame_id='map',
    )
    assert len(tracker.process(start)[-1]) == before + 1
    for item in scans[11:]:
        made = tracker.process(item)[-1]
    assert len(set(made.extras['track_id'].tolist())) == len(made)


def test_the_past_that_led_to_the_end_is_smoothed():
    scene = simulate(scenario('crossing', {'duration': 40.0}), 3)
    tracker = SmoothingDiverTracker(CROSSING)
    live = [tracker.process(item.measurement)[-1] for item in scene.measurements]
    smoothed = tracker.smoothed()
    assert [each.stamp_ns for each in smoothed] == [each.stamp_ns for each in live]
    assert smoothed[-1].state == pytest.approx(live[-1].state, abs=1e-9)
    last = smoothed[-1].extras['track_id'][smoothed[-1].extras['track_state'] > 0]
    assert len(last) == 4
    before, after = (errors_of(made, last, scene.truth) for made in (live, smoothed))
    assert after < 0.8 * before


def test_fixes_in_another_order_are_the_same_tracks():
    first, other = DiverTracker(CROSSING), DiverTracker(CROSSING)
    for item in crossing(duration=15.0):
        a = first.process(item)[-1]
        order = np.arange(len(item))[::-1]
        b = other.process(
            Fixes(
                stamp_ns=item.stamp_ns,
                position=item.position[order],
                covariance=item.covariance[order],
                frame_id='map',
            )
        )[-1]
        places = [np.array(sorted(map(tuple, each.state))) for each in (a, b)]
        assert places[0] == pytest.approx(places[1], abs=1e-6)
