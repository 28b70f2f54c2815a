# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What all depths share: the error of the told depth of the array, found and followed, or a state
of its own; jumps that all reflectors make together; and the error of the sound speed."""

from attrs import evolve
from helpers.fathometer_runs import run
from helpers.moving_layers import scene
from helpers.sea_scenes import score_scene, sea_scene
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from benchmarks.fathometer_sea import scene as gaps_scene
from sonar_imm.measurements import Rejection, Trace
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.datum import (
    BENDS,
    DatumError,
    error_weights,
    ERRORS,
    STEPS,
    STEPS_PRIOR,
)
from sonar_imm.trackers.fathometer.reflectors import Identified, Identities
from sonar_imm.trackers.fathometer.response import common_jump, lattice_of_trace
from sonar_imm.trackers.fathometer.slopes import begun, Common, learned, Slope
from sonar_imm.trackers.fathometer.tracker import FathometerTracker


@pytest.fixture(scope='module')
def heaving():
    return sea_scene('heave')


def errors(found, heaving, after):
    """Common error (T,) of the depths of each record, the errors relative to it, and how wrong the
    heave is, with its stated standard deviation (T,)."""
    common, relative, heave, stated = [], [], [], []
    for stamp, estimate in found.items():
        if stamp <= after * 10**9 or len(estimate) != len(heaving.amplitude):
            continue
        error = estimate.state[:, 0] - heaving.depth_at(stamp)
        common.append(error.mean())
        relative.append(error - error.mean())
        given = heaving.file['array_depth_error'][stamp // 10**9 - 1]
        heave.append(estimate.extras['heave'][0] - given)
        stated.append(estimate.extras['heave_std'][0])
        assert np.ptp(estimate.extras['heave']) == 0.0
    return np.array(common), np.concatenate(relative), np.array(heave), np.array(stated)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def test_layers_are_followed_although_the_array_heaves(heaving):
    _, found = run(
        heaving.traces(), particles=3000, heave='independent', array_depth_std=0.5,
        sound_speed_std=0.0,
    )  # fmt: skip
    score = score_scene(found, heaving, after=20)
    common, relative, heave, stated = errors(found, heaving, after=20)
    assert score.right >= 0.95 and score.ospa <= 0.18
    assert rms(common) <= 0.20 and rms(relative) <= 0.02
    # What the heave is not, the depths are.
    assert heave == pytest.approx(-common, abs=0.03)
    assert (np.abs(heave) < 3.0 * stated).all() and stated.mean() < 0.25
    last = found[60 * 10**9]
    assert last.covariance[:, 0, 0] == pytest.approx(stated[-1] ** 2, rel=0.25)
    expected = 2.0 * (last.state[:, 0] - heaving.array_depth) / 1500.0
    assert last.extras['two_way_time'] == pytest.approx(expected, abs=1e-12)


def lasting(heaving, seed, records=40):
    """The same layers, the errors of an autoregression in place of the independent ones; and these
    errors."""
    rng = np.random.default_rng(seed)
    wrong = 0.5 * rng.standard_normal(records)
    for k in range(1, records):
        wrong[k] = 0.9 * wrong[k - 1] + np.sqrt(1.0 - 0.81) * wrong[k]
    traces = [
        Trace(
            stamp_ns=each.stamp_ns,
            depth=each.depth - heaving.file['array_depth_error'][k] + wrong[k],
            amplitude=each.amplitude,
            sigma=each.sigma,
            reference_depth=heaving.array_depth,
        )
        for k, each in enumerate(heaving.traces(range(records)))
    ]
    return traces, wrong


WINDOW = {'depth_min': 42.5, 'depth_max': 69.0, 'depth_step': 1 / 64}


def kalman(seen, layers, depth_std, memory, lag=0):
    """Mean and sd (T, 2) of the shift whose sum with the mean depth is `seen` (T,), by what is
    seen up to `lag` records later: all of it is jointly Gaussian."""
    records, std = np.arange(len(seen)), 0.5
    walk = 1e4 + depth_std**2 / layers * np.minimum.outer(records, records)
    shift = std**2 * np.where(np.eye(len(seen)) > 0, 1.0, 0.0)
    if memory:
        shift = std**2 * memory ** np.abs(np.subtract.outer(records, records))
    found, off = [], np.array(seen) - seen[0]
    for k in range(len(seen) - lag):
        upto = slice(0, k + lag + 1)
        gain = np.linalg.solve((walk + shift)[upto, upto], shift[upto, k])
        found.append((gain @ off[upto], np.sqrt(std**2 - gain @ shift[upto, k])))
    return np.array(found)


def compare_with_kalman(heaving, heave, seed, depth_std, lag, largest):
    if heave == 'memory':
        traces, wrong = lasting(heaving, seed)
    else:
        traces, wrong = list(heaving.traces(range(40))), heaving.file['array_depth_error'][:40]
    options = {'heave': heave, 'array_depth_std': 0.5, 'depth_std': depth_std, **WINDOW}
    _, found = run(traces, particles=3000, seed=seed, smoothing_lag=lag, **options)
    seen = [heaving.depth_at(each.stamp_ns).mean() + w for each, w in zip(traces, wrong)]
    memory = 0.9 if heave == 'memory' else 0.0
    expected = kalman(seen, len(heaving.amplitude), depth_std, memory, lag)
    made = list(found.values())[: len(expected)]
    heaves = np.array([[each.extras[k][0] for k in ('heave', 'heave_std')] for each in made])
    assert heaves[:, 1] == pytest.approx(expected[:, 1], rel=0.08)
    away = (heaves[:, 0] - expected[:, 0]) / expected[:, 1]
    assert rms(away) < 0.1 and np.abs(away).max() < largest


@pytest.mark.statistics
@pytest.mark.parametrize('heave', ['independent', 'memory'])
@pytest.mark.parametrize(('seed', 'depth_std'), [(1, 0.1), (2, 0.3)])
def test_the_heave_is_known_as_a_kalman_filter_knows_it(heaving, heave, seed, depth_std):
    """Two Gaussian numbers, heave and depth, which no record tells apart."""
    compare_with_kalman(heaving, heave, seed, depth_std, 0, 0.2)


@pytest.mark.parametrize(('heave', 'lag'), [('independent', 5), ('memory', 2)])
def test_the_heave_of_revised_records_is_known_as_what_came_later_tells(heaving, heave, lag):
    """The offset is known as the newest record knows it, not as the revised one did."""
    compare_with_kalman(heaving, heave, 1, 0.1, lag, 0.25)


def test_an_error_that_lasts_is_followed_with_a_memory(heaving):
    traces, _ = lasting(heaving, 2)
    _, found = run(traces, particles=3000, heave='memory', array_depth_std=0.5, **WINDOW)
    assert score_scene(found, heaving, after=15).right >= 0.95
    _, relative, _, _ = errors(found, heaving, after=15)
    assert rms(relative) <= 0.03


def test_what_heave_needs():
    config = FathometerConfig(heave='independent', array_depth_std=1000.0, depth_std=0.01)
    depth = np.arange(100.0, 120.0, 0.01)
    trace = Trace(stamp_ns=1, depth=depth, amplitude=np.sin(depth))
    with pytest.raises(Rejection, match='steps'):
        lattice_of_trace(trace, config)


def test_a_new_spread_of_the_heave_begins_anew(heaving):
    options = {'particles': 200, 'heave': 'independent'}
    tracker = FathometerTracker(FathometerConfig(**options, array_depth_std=0.5))
    traces = list(heaving.traces(range(3)))
    tracker.process(traces[0])
    tracker.reconfigure(FathometerConfig(**options, array_depth_std=0.1))
    (estimate,) = tracker.process(traces[1])
    assert len(tracker.response.depth) < len(traces[1]) + 2 * 40
    assert np.isfinite(estimate.extras['heave_std']).all()


ARRAY = 30.0  # m, of the scene
EXACT = {'sound_speed_std': 5.0, 'particles': 500}
"""For what holds whatever the particles are."""


@pytest.fixture(scope='module')
def drawn():
    return gaps_scene(0, 0.1, 4)


def followed(drawn, **options):
    """Of the later records: depths, true ones by the speed of the scene, variances, estimates."""
    traces, truth = drawn
    _, found = run(traces, **{'particles': 1500, 'array_depth_std': 0.03, **options})
    rows = [(each, z) for each, z in zip(found.values(), truth) if len(each) == len(z)][5:]
    assert len(rows) > 15
    depth = np.array([each.state[:, 0] for each, _ in rows])
    variance = np.array([each.covariance[:, 0, 0] for each, _ in rows])
    return depth, np.array([z for _, z in rows]), variance, [each for each, _ in rows]


def share_inside(depth, truth, variance, faster):
    """Share of the depths within two standard deviations where the sound is so many m/s faster."""
    true = ARRAY + (truth - ARRAY) * (1500.0 + np.reshape(faster, (-1, 1, 1))) / 1500.0
    return float(np.mean(np.abs(depth - true) <= 2.0 * np.sqrt(variance)))


def test_depths_have_the_error_of_a_speed_that_is_off(drawn):
    exact = followed(drawn, sound_speed_std=0.0, array_depth_std=0.0)
    assert share_inside(*exact[:3], 0.0) > 0.95
    assert share_inside(*exact[:3], 5.0) < 0.3 and share_inside(*exact[:3], 10.0) < 0.05
    speeds = np.random.default_rng(0).standard_normal(400)
    for std in (2.0, 5.0, 10.0):
        stated = followed(drawn, sound_speed_std=std, array_depth_std=0.0)
        assert share_inside(*stated[:3], std * speeds) == pytest.approx(0.95, abs=0.025)
        # Nothing but the covariance is another one.
        assert stated[0].tobytes() == exact[0].tobytes()
    default = followed(drawn)
    assert share_inside(*default[:3], 5.0) == share_inside(*default[:3], 10.0) == 1.0


def test_what_is_common_and_what_is_relative_add_up(drawn):
    depth, truth, variance, estimates = followed(drawn, sound_speed_std=5.0)
    common = np.array([each.extras['depth_common_std'] for each in estimates])
    relative = np.array([each.extras['depth_relative_std'] for each in estimates])
    assert common**2 + relative**2 == pytest.approx(variance, rel=1e-3)
    # The rest is the depth of the array, of which a few records say less than many.
    array = common**2 - ((depth - ARRAY) / 300.0) ** 2
    assert array == pytest.approx(np.tile(array[:, :1], array.shape[1]), abs=1e-9)
    assert array.max() < 0.04**2 and array[3:] == pytest.approx(0.03**2, abs=1e-9)
    thickness = np.diff(depth) - np.diff(truth)
    spread = np.sqrt(relative[:, 1:] ** 2 + relative[:, :-1] ** 2)
    assert np.mean(np.abs(thickness) <= 2.0 * spread) > 0.9


def test_heave_is_what_is_common_in_place_of_the_depth_of_the_array(drawn):
    depth, _, variance, estimates = followed(drawn, **EXACT, heave='independent')
    height = depth + np.array([each.extras['heave'] for each in estimates]) - ARRAY
    stated = np.array([each.extras['heave_std'] for each in estimates])
    common = np.array([each.extras['depth_common_std'] for each in estimates])
    assert common**2 == pytest.approx(stated**2 + (height / 300.0) ** 2, rel=1e-9)


def test_the_speed_of_the_water_counts_down_to_the_bottom(drawn):
    """Where the sediment has a speed of its own; else it is water."""
    *_, water = followed(drawn, **EXACT)
    *_, own = followed(drawn, **EXACT, sediment_sound_speed=1500.0)
    *_, exact = followed(drawn, **EXACT | {'sound_speed_std': 0.0})
    for each, other, none in zip(water, own, exact):
        height = each.state[:, 0] - ARRAY
        without = none.extras['sediment_depth_std'] ** 2
        assert each.extras['sediment_depth_std'] ** 2 - without == pytest.approx(
            (height / 300.0) ** 2, rel=1e-6
        )
        assert other.extras['sediment_depth_std'] ** 2 - without == pytest.approx(
            np.full(len(height), (height[0] / 300.0) ** 2), rel=1e-6
        )


FEW = {'particles': 2000, 'frequency_min': 100.0, 'frequency_max': 2800.0, 'sound_speed_std': 0.0}


def found_of(changes):
    datum = DatumError()
    for change in changes:
        datum.add(float(change))
    return datum


def test_errors_of_the_vectors():
    scalars = load_vectors('fathometer_in_the_field/scalars')
    # Theirs are moments, which waves of the floor leave a quarter too small or too great.
    for kind, within in (('', 0.1), ('_fault', 0.1), ('_waves', 0.25)):
        found = found_of(scalars[f'change{kind}'][-40:]).found
        assert found == pytest.approx(float(scalars[f'found{kind}']), rel=within)


def test_weights_are_those_of_the_joint_normal_density():
    rng = np.random.default_rng(2)
    n, changes, noise = 6, 0.1 * rng.standard_normal(6), np.full(7, 0.03**2)
    one = np.ones((n, n))
    difference = np.eye(n, n + 1, 1) - np.eye(n, n + 1)
    sums = np.tril(one)
    total, seen = 0.0, []
    for error, prior in zip(ERRORS, [0.2, *[0.8 / 15] * 15]):
        sum_of_one = 0.0
        for step, likely in zip(STEPS, STEPS_PRIOR):
            for bend in BENDS:
                covariance = 0.4**2 * one + bend**2 * sums @ sums.T + step**2 * np.eye(n)
                covariance += difference @ np.diag(error**2 + noise) @ difference.T
                sum_of_one += likely * multivariate_normal(cov=covariance).pdf(changes)
        seen.append(prior * sum_of_one)
        total += seen[-1]
    # A fault is possible at each change, which costs the density .005.
    found = error_weights(np.column_stack([changes, noise[1:]]))
    assert found == pytest.approx(np.array(seen) / total, abs=0.01)


def test_what_is_found_of_an_error_a_slope_and_a_fault():
    rng, config, record = np.random.default_rng(0), FathometerConfig(), np.arange(41)
    found, sure = [], []
    for _ in range(60):
        datum = found_of(np.diff(0.2 * rng.standard_normal(41)))
        found.append(datum.found)
        sure.append(datum.exceeds(config))
    assert np.median(found) == pytest.approx(0.2, rel=0.15) and np.mean(sure) > 0.9
    early = [found_of(np.diff(0.5 * rng.standard_normal(6))).found for _ in range(60)]
    assert np.mean(early) == pytest.approx(0.5, rel=0.25)
    fault = np.where(record >= 20, 3.0, 0.0) + 0.01 * rng.standard_normal(41)
    for floor in (2.5 * np.sin(2.0 * np.pi * record / 25.0), 0.18 * record, fault, 0.0 * record):
        datum = found_of(np.diff(floor))
        assert datum.found < 0.03 and not datum.exceeds(config)
    # All layers of a rough floor step together, and look not back.
    steps = [found_of(0.3 * rng.standard_normal(40)).exceeds(config) for _ in range(60)]
    assert np.mean(steps) < 0.1


def test_an_error_counts_after_four_changes_and_is_followed_after_eight():
    config = FathometerConfig()
    changes = np.diff(0.8 * np.random.default_rng(4).standard_normal(9))
    assert found_of(changes[:3]).found == 0.0 and found_of(changes[:4]).found > 0.2
    datum = found_of(changes[:7])
    assert not datum.follow(config) and not datum.followed
    datum.add(changes[7])
    assert not datum.exceeds(FathometerConfig(array_depth_std=1.0))
    assert not datum.exceeds(FathometerConfig(array_depth_std=0.0))
    assert datum.follow(config) and datum.followed == datum.found
    assert not datum.follow(config)
    for _ in range(40):
        datum.add(0.0)
    assert datum.follow(config) and datum.followed < 0.1


def inside(found, true, after):
    """Share of the depths within two stated standard deviations."""
    good = []
    for stamp, each in found.items():
        if stamp <= after * 10**9:
            continue
        off = np.abs(each.state[:, :1] - true[stamp // 10**9 - 1])
        good += (off.min(axis=1) <= 2.0 * np.sqrt(each.covariance[:, 0, 0])).tolist()
    return np.mean(good)


def test_a_depth_that_is_wrong_anew_in_each_record_is_followed():
    error = 0.2 * np.random.default_rng(1).standard_normal(36)
    traces, true = scene(error, 2)
    tracker, found = run(traces, **FEW)
    newest = found[36 * 10**9]
    assert newest.extras['array_depth_found'][0] == pytest.approx(0.2, abs=0.08)
    assert newest.extras['heave_std'][0] > 0.0
    assert inside(found, true, 18) > 0.85
    assert any('it is followed as heave' in each for each in tracker.warnings())
    # A state, and not only a wider covariance: depths are better than what is told of the array.
    settled = range(25, 37)
    rms = np.sqrt(
        np.mean([np.square(found[k * 10**9].state[:, 0] - true[k - 1]).mean() for k in settled])
    )
    assert rms < 0.12

    tracker, plain = run(traces, **FEW, heave='none')
    assert inside(plain, true, 18) > 0.6
    assert len(set(np.concatenate([e.extras['track_id'] for e in plain.values()]))) == 6
    assert plain[36 * 10**9].extras['heave_std'][0] == 0.0
    assert any('heave auto follows it' in each for each in tracker.warnings())


@pytest.mark.parametrize('kind', ['still', 'fault'])
def test_a_right_depth_is_left_alone(kind):
    floor = np.zeros(36)
    if kind == 'fault':
        floor[20:] = 1.0
    traces, true = scene(np.zeros(36), 3, floor=floor)
    tracker, found = run(traces, **FEW)
    newest = found[36 * 10**9]
    assert newest.extras['array_depth_found'][0] < 0.05
    assert newest.extras['heave_std'][0] == 0.0 and tracker.warnings() == []


def test_all_keep_their_ids_when_a_great_error_is_followed():
    error = 0.5 * np.random.default_rng(7).standard_normal(26)
    traces, _ = scene(error, 2, 26)
    tracker, found = run(traces, **FEW)
    assert tracker.warnings() and found[26 * 10**9].extras['heave_std'][0] > 0.0
    late = [each.extras['track_id'].tolist() for stamp, each in found.items() if stamp > 10**10]
    assert all(ids == late[0] for ids in late)


def test_the_last_records_say_where_the_layers_lie_once_an_error_is_followed():
    error = 0.5 * np.random.default_rng(16).standard_normal(12)
    traces, true = scene(error, 2, 12)
    _, found = run(traces, **FEW)
    first = next(k for k in range(1, 13) if found[k * 10**9].extras['heave_std'][0] > 0.0)
    off = found[first * 10**9].state[:, 0] - true[first - 1]
    # Layers that stay are where the mean of the records has them, not where the newest shows them.
    eight = error[first - 8 : first].mean()
    assert abs(error[first - 1] - eight) > 0.5
    np.testing.assert_allclose(off, eight, atol=0.1)
    assert found[first * 10**9].extras['heave'][0] == pytest.approx(
        error[first - 1] - eight, abs=0.1
    )


def test_what_all_are_off_by_together():
    known = Identities(tuple(Identified(k, z, 0) for k, z in enumerate((50.0, 54.0, 61.0, 66.0))))
    seen = np.array([50.9, 54.92, 57.0, 66.9])
    assert known.offset(seen, 1.5, 0.4) == pytest.approx(0.9, abs=0.03)
    assert known.offset(seen, 0.5, 0.4) == 0.0
    # One alone says nothing of the others, and those that are near stay.
    assert known.offset(np.array([50.9]), 1.5, 0.4) == 0.0
    assert known.offset(np.array([50.05, 54.0, 61.1, 67.0]), 1.5, 0.4) == pytest.approx(
        0.0, abs=0.1
    )
    assert known.offset(seen, 0.0, 0.4) == 0.0
    assert known.offset(np.empty(0), 1.5, 0.4) == 0.0
    assert Identities().offset(seen, 1.5, 0.4) == 0.0


FEWER = {**FEW, 'particles': 1500}
RECORDS, AT = 24, 14


def tracked(floor, **options):
    """The tracker; share of the records after the fifth with six reflectors; ids that each of the
    six true layers had then; and the estimates."""
    traces, true = scene(np.zeros(len(floor)), 5, len(floor), floor)
    tracker, found = run(traces, **{**FEWER, **options})
    ids, right = [set() for _ in range(6)], []
    for k in range(5, len(floor)):
        each = found[(k + 1) * 10**9]
        right.append(len(each.state) == 6)
        for layer, z in zip(ids, true[k]):
            layer.add(int(each.extras['track_id'][np.argmin(np.abs(each.state[:, 0] - z))]))
    return tracker, float(np.mean(right)), [len(layer) for layer in ids], found


@pytest.mark.parametrize('jump', [3.0, -2.2])
def test_after_a_fault_all_have_their_ids(jump):
    floor = jump * (np.arange(RECORDS) >= AT)
    tracker, right, ids, found = tracked(floor)
    assert right == 1.0 and ids == [1] * 6
    drawn = np.array([each.extras['common_jump'][0] for each in found.values()])
    assert drawn[AT] == pytest.approx(jump, abs=0.1)
    assert np.abs(np.delete(drawn, AT)).max() < 0.1
    (said,) = tracker.warnings()
    assert said.startswith(f'all reflectors jumped together in 1 record, by {jump:+.1f} m')
    # Nothing is taken for a slope.
    assert found[RECORDS * 10**9].extras['dipping'].max() < 0.2


def test_over_steep_waves_all_keep_their_ids():
    floor = 4.0 * np.sin(2.0 * np.pi * np.arange(30) / 25.0)
    tracker, right, ids, _ = tracked(floor)
    assert right == 1.0 and ids == [1] * 6
    assert tracker.warnings() == []


def test_what_dips_is_still_a_slope():
    tracker, right, ids, found = tracked(0.3 * np.arange(RECORDS) - 4.0)
    newest = found[RECORDS * 10**9]
    assert right == 1.0 and ids == [1] * 6 and tracker.warnings() == []
    assert newest.extras['dipping'].min() > 0.9
    assert newest.extras['slope'] == pytest.approx(0.3, abs=0.03)


def test_a_jump_within_a_gap():
    floor = 2.5 * (np.arange(RECORDS) >= AT)
    traces, true = scene(np.zeros(RECORDS), 5, RECORDS, floor)
    tracker, found = run(traces[: AT - 2] + traces[AT + 1 :], **FEWER, record_interval=1.0)
    before, after = found[(AT - 2) * 10**9], found[(AT + 2) * 10**9]
    assert after.state[:, 0] == pytest.approx(true[AT], abs=0.1)
    assert after.extras['track_id'].tolist() == before.extras['track_id'].tolist()


def test_what_is_smoothed_has_the_ids_of_before_the_jump():
    floor = 3.0 * (np.arange(RECORDS) >= AT)
    tracker, right, ids, found = tracked(floor, smoothing_lag=2)
    assert ids == [1] * 6
    drawn = [found[(k + 1) * 10**9].extras['common_jump'][0] for k in range(RECORDS - 2)]
    assert int(np.argmax(drawn)) == AT


def test_with_heave_there_are_none_and_the_grid_has_a_bound():
    config = FathometerConfig(heave='none')
    jump = common_jump(config, 0.05)
    assert (jump.step, jump.pad * 0.05) == (1, 4.0) and jump.std == pytest.approx(30.0)
    assert common_jump(config, 1.0 / 64.0).step == 4
    assert common_jump(config, 0.5).pad == 8
    for changed in (
        evolve(config, common_jump_probability=0.0),
        evolve(config, heave='independent'),
    ):
        assert common_jump(changed, 0.05) is None
    wide = common_jump(evolve(config, common_jump_std=100.0), 0.01)
    assert wide.reach <= 200 and wide.pad * 0.01 == pytest.approx(267.0, rel=0.01)


def test_what_slopes_explain_is_no_jump():
    config = FathometerConfig()
    slope, common = Slope(0.0, 0.0, 0.16, 1e-4), Common()
    plain = learned(slope, common, 0.02, 1e-4, 1, config)
    far = learned(slope, common, 0.02, 1e-4, 1, config, 3.0)
    assert tuple(far) == pytest.approx(tuple(plain), abs=1e-7)
    # The first time either may be, the second time it is a slope.
    once = learned(slope, common, 0.0, 1e-4, 1, config, 0.5)
    assert 0.3 < once.dipping < 0.7 and once.mean == pytest.approx(0.48, abs=0.05)
    twice = learned(once, common, 0.0, 1e-4, 1, config, 0.5)
    assert twice.dipping > 0.9 and twice.mean == pytest.approx(0.5, abs=0.05)
    # By both, weighted by how probable they are.
    std = np.sqrt(0.16 + 0.01 + 2e-4)
    turned = 0.02 * np.exp(-0.5 * (0.5 / std) ** 2) / std
    still = 0.98 * np.exp(-0.5 * 0.25 / 0.0102) / np.sqrt(0.0102)
    leap = 0.05 * np.exp(-0.5 * (0.5 / 1.5) ** 2) / 1.5
    slopes = (turned + still) / (turned + still + leap)
    share = turned / (turned + still)
    expected = (
        slopes * share + (1.0 - slopes) * learned(slope, common, 0.0, 1e-4, 1, config).dipping
    )
    assert once.dipping == pytest.approx(expected, rel=1e-6)


def test_those_that_are_waited_for_jump_as_well():
    slope = begun(Common(), 1e-4, FathometerConfig())
    known = Identities((Identified(3, 50.0, 0, 0, slope), Identified(5, 60.0, 2, 0, slope)), 6)
    moved = known.moved(-2.0)
    assert [each.depth for each in moved.reflectors] == [48.0, 58.0]
    assert [each.missed for each in moved.reflectors] == [0, 2] and known.moved(0.0) is known
