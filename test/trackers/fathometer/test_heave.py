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
from helpers.fathometer_runs import run, score_scene, sea_scene
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from benchmarks.fathometer_sea import scene as gaps_scene
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer import datum as datums
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.datum import DatumError, error_weights
from sonar_imm.trackers.fathometer.reflectors import Identified, Identities
from sonar_imm.trackers.fathometer.response import common_jump
from sonar_imm.trackers.fathometer.slopes import begun, Common, learned, Slope

ARRAY = 30.0  # m, of the scene
FEW = {'particles': 2000, 'frequency_min': 100.0, 'frequency_max': 2800.0, 'sound_speed_std': 0.0}
LAYERS = np.array([52.0, 56.5, 60.0, 64.2, 68.0, 72.5])
STRENGTH = np.array([25.0, 18.0, 13.0, 10.0, 8.5, 7.0])
FEWER = {**FEW, 'particles': 1500}
RECORDS, AT = 24, 14


@pytest.fixture(scope='module')
def heaving():
    return sea_scene('heave')


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def lasting(heaving, seed, records=40):
    """The same layers, the errors of an autoregression in place of the independent ones; and these
    errors."""
    wrong = 0.5 * np.random.default_rng(seed).standard_normal(records)
    for k in range(1, records):
        wrong[k] = 0.9 * wrong[k - 1] + np.sqrt(1.0 - 0.81) * wrong[k]
    off = wrong - heaving.file['array_depth_error'][:records]
    pairs = zip(heaving.traces(range(records)), off)
    return [evolve(each, depth=each.depth + by) for each, by in pairs], wrong


def kalman(seen, layers, depth_std, memory, lag=0):
    """Mean and sd (T, 2) of the shift whose sum with the mean depth is `seen` (T,), by what is
    seen up to `lag` records later: all of it is jointly Gaussian."""
    records, std = np.arange(len(seen)), 0.5
    walk = 1e4 + depth_std**2 / layers * np.minimum.outer(records, records)
    shift = std**2 * memory ** np.abs(np.subtract.outer(records, records))
    found, off = [], np.array(seen) - seen[0]
    for k in range(len(seen) - lag):
        upto = slice(0, k + lag + 1)
        gain = np.linalg.solve((walk + shift)[upto, upto], shift[upto, k])
        found.append((gain @ off[upto], np.sqrt(std**2 - gain @ shift[upto, k])))
    return np.array(found)


@pytest.mark.parametrize('heave, seed, depth_std, lag', [
    ('independent', 1, 0.1, 5), ('memory', 1, 0.1, 2),
    pytest.param('independent', 2, 0.3, 0, marks=pytest.mark.statistics),
    pytest.param('memory', 2, 0.3, 0, marks=pytest.mark.statistics),
])  # fmt: skip
def test_the_heave_is_known_as_a_kalman_filter_knows_it(heaving, heave, seed, depth_std, lag):
    """Two Gaussian numbers, heave and depth, which no record tells apart. Of revised records the
    offset is known as the newest one knows it."""
    window = {'depth_min': 42.5, 'depth_max': 69.0, 'depth_step': 1 / 64}
    if heave == 'memory':
        traces, wrong = lasting(heaving, seed)
    else:
        traces, wrong = list(heaving.traces(range(40))), heaving.file['array_depth_error'][:40]
    options = {'heave': heave, 'array_depth_std': 0.5, 'depth_std': depth_std, **window}
    _, found = run(traces, particles=3000, seed=seed, smoothing_lag=lag, **options)
    seen = [heaving.depth_at(each.stamp_ns).mean() + w for each, w in zip(traces, wrong)]
    memory = 0.9 if heave == 'memory' else 0.0
    expected = kalman(seen, len(heaving.amplitude), depth_std, memory, lag)
    made = list(found.values())[: len(expected)]
    heaves = np.array([[each.extras[k][0] for k in ('heave', 'heave_std')] for each in made])
    assert heaves[:, 1] == pytest.approx(expected[:, 1], rel=0.08)
    away = (heaves[:, 0] - expected[:, 0]) / expected[:, 1]
    assert rms(away) < 0.1 and np.abs(away).max() < 0.25
    # What the heave is not, the depths are; relative to each other they are as good as ever.
    assert score_scene(found, heaving.depth_at, after=20).right >= 0.95
    for each, given, k in zip(made, wrong, range(len(made))):
        if k >= 20 and len(each) == len(heaving.amplitude):
            error = each.state[:, 0] - heaving.depth_at(each.stamp_ns)
            assert np.ptp(each.extras['heave']) == 0.0
            assert error.mean() == pytest.approx(given - each.extras['heave'][0], abs=0.05)
            assert rms(error - error.mean()) <= 0.05
            due = 2.0 * (each.state[:, 0] - heaving.array_depth) / 1500.0
            assert each.extras['two_way_time'] == pytest.approx(due, abs=1e-12)


def test_a_new_spread_of_the_heave_begins_anew(heaving):
    options = {'particles': 200, 'heave': 'independent'}
    first, second = heaving.traces(range(2))
    tracker, _ = run([first], **options, array_depth_std=0.5)
    tracker.reconfigure(FathometerConfig(**options, array_depth_std=0.1))
    (estimate,) = tracker.process(second)
    assert len(tracker.response.depth) < len(second) + 2 * 40
    assert np.isfinite(estimate.extras['heave_std']).all()


@pytest.fixture(scope='module')
def drawn():
    return gaps_scene(0, 0.1, 4)


def followed(drawn, **options):
    """Of the later records: depths, true ones, variances, estimates."""
    traces, truth = drawn
    _, found = run(traces, particles=500, sound_speed_std=5.0, array_depth_std=0.03, **options)
    rows = [(each, z) for each, z in zip(found.values(), truth) if len(each) == len(z)][5:]
    assert len(rows) > 15
    depth = np.array([each.state[:, 0] for each, _ in rows])
    variance = np.array([each.covariance[:, 0, 0] for each, _ in rows])
    return depth, np.array([z for _, z in rows]), variance, [each for each, _ in rows]


def test_what_is_common_and_what_is_relative_add_up(drawn):
    depth, truth, variance, estimates = followed(drawn)
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


def test_heave_and_the_speed_of_the_water_down_to_the_bottom_are_common(drawn):
    """Heave in place of the depth of the array; the water's speed to the bottom where the sediment
    has a speed of its own; else it is water."""
    depth, _, _, estimates = followed(drawn, heave='independent')
    names = 'heave', 'heave_std', 'depth_common_std'
    rows = (np.array([each.extras[name] for each in estimates]) for name in names)
    heave, stated, common = rows
    height = depth + heave - ARRAY
    assert common**2 == pytest.approx(stated**2 + (height / 300.0) ** 2, rel=1e-9)
    depth, *_, water = followed(drawn)
    *_, own = followed(drawn, sediment_sound_speed=1500.0)
    water, own = (
        np.array([each.extras['sediment_depth_std'] ** 2 for each in row]) for row in (water, own)
    )
    # Of the bottom they are the same; below it the speed of the water has its share in one only.
    height = depth - ARRAY
    bottom = np.broadcast_to(height[:, :1], height.shape)
    due = (height**2 - bottom**2) / 300.0**2
    assert water - own == pytest.approx(due, rel=1e-6, abs=1e-9)


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
    for error, prior in zip(datums.ERRORS, [0.2, *[0.8 / 15] * 15]):
        sum_of_one = 0.0
        for step, likely in zip(datums.STEPS, datums.STEPS_PRIOR):
            for bend in datums.BENDS:
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
    drawn = [found_of(np.diff(0.2 * rng.standard_normal(41))) for _ in range(60)]
    assert np.median([each.found for each in drawn]) == pytest.approx(0.2, rel=0.15)
    assert np.mean([each.exceeds(config) for each in drawn]) > 0.9
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
    for std in (1.0, 0.0):
        assert not datum.exceeds(FathometerConfig(array_depth_std=std))
    assert datum.follow(config) and datum.followed == datum.found
    assert not datum.follow(config)
    for _ in range(40):
        datum.add(0.0)
    assert datum.follow(config) and datum.followed < 0.1


def inside(found, true, after):
    """Share of the depths within two stated standard deviations."""
    good = []
    for stamp, each in found.items():
        if stamp > after * 10**9:
            off = np.abs(each.state[:, :1] - true[stamp // 10**9 - 1]).min(axis=1)
            good += (off <= 2.0 * np.sqrt(each.covariance[:, 0, 0])).tolist()
    return np.mean(good)


def scene(error, seed, floor=None):
    """Traces of six layers as an array at 30 m sees them, told by `error` m (T,) wrongly; and the
    true depths (T, 6). Only lags are seen: the stated depth shifts all that is drawn."""
    rng, pulse = np.random.default_rng(seed), band_pulse(100.0, 2800.0, 1500.0)
    depth, traces = np.arange(42.0, 82.0, 0.05), []
    true = LAYERS + (np.zeros(len(error)) if floor is None else floor)[:, None]
    kernel = pulse(0.05 * np.arange(-60, 61))
    known = {'depth': depth, 'sigma': np.ones(len(depth))}
    for k, wrong in enumerate(error):
        noise = np.convolve(rng.standard_normal(len(depth) + 120), kernel, 'valid')
        heard = pulse(depth[:, None] - true[k] - wrong) @ STRENGTH
        heard += noise / np.sqrt(np.sum(np.square(kernel)))
        known |= {'stamp_ns': (k + 1) * 10**9, 'reference_depth': 30.0 + wrong}
        traces.append(Trace(amplitude=heard, **known))
    return traces, true


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
    assert rms([found[k * 10**9].state[:, 0] - true[k - 1] for k in range(25, 37)]) < 0.12

    tracker, plain = run(traces, **FEW, heave='none')
    assert inside(plain, true, 18) > 0.6
    assert len(set(np.concatenate([e.extras['track_id'] for e in plain.values()]))) == 6
    assert plain[36 * 10**9].extras['heave_std'][0] == 0.0
    assert any('heave auto follows it' in each for each in tracker.warnings())


def test_all_keep_their_ids_when_a_great_error_is_followed():
    traces, _ = scene(0.5 * np.random.default_rng(7).standard_normal(26), 2)
    tracker, found = run(traces, **FEW)
    assert tracker.warnings() and found[26 * 10**9].extras['heave_std'][0] > 0.0
    late = [each.extras['track_id'].tolist() for stamp, each in found.items() if stamp > 10**10]
    assert all(ids == late[0] for ids in late)


def test_the_last_records_say_where_the_layers_lie_once_an_error_is_followed():
    error = 0.5 * np.random.default_rng(16).standard_normal(12)
    traces, true = scene(error, 2)
    _, found = run(traces, **FEW)
    k = next(k for k in range(12) if found[(k + 1) * 10**9].extras['heave_std'][0] > 0.0)
    # Layers that stay are where the mean of the records has them, not where the newest shows them.
    first, eight = found[(k + 1) * 10**9], error[k - 7 : k + 1].mean()
    assert abs(error[k] - eight) > 0.5
    np.testing.assert_allclose(first.state[:, 0] - true[k], eight, atol=0.1)
    assert first.extras['heave'][0] == pytest.approx(error[k] - eight, abs=0.1)


def test_what_all_are_off_by_together():
    known = Identities(tuple(Identified(k, z, 0) for k, z in enumerate((50.0, 54.0, 61.0, 66.0))))
    seen = [50.9, 54.92, 57.0, 66.9]
    # One alone says nothing of the others, and those that are near stay.
    for depths, reach, due in (
        (seen, 1.5, 0.9), (seen, 0.5, 0.0), (seen, 0.0, 0.0), ([], 1.5, 0.0), ([50.9], 1.5, 0.0),
        ([50.05, 54.0, 61.1, 67.0], 1.5, 0.0),
    ):  # fmt: skip
        assert known.offset(np.array(depths), reach, 0.4) == pytest.approx(due, abs=0.1)
    assert Identities().offset(np.array(seen), 1.5, 0.4) == 0.0


def tracked(floor, **options):
    """The tracker, with its estimates. After the fifth record all six layers are there, each with
    one id."""
    traces, true = scene(np.zeros(len(floor)), 5, floor)
    tracker, found = run(traces, **{**FEWER, **options})
    ids = set()
    for k in range(5, len(floor)):
        each = found[(k + 1) * 10**9]
        assert len(each) == 6
        nearest = np.abs(each.state[:, :1] - true[k]).argmin(axis=0)
        ids.add(tuple(each.extras['track_id'][nearest].tolist()))
    assert len(ids) == 1
    return tracker, found


def test_after_a_fault_all_have_their_ids():
    for jump in (3.0, -2.2):
        tracker, found = tracked(jump * (np.arange(RECORDS) >= AT))
        drawn = np.array([each.extras['common_jump'][0] for each in found.values()])
        assert drawn[AT] == pytest.approx(jump, abs=0.1)
        assert np.abs(np.delete(drawn, AT)).max() < 0.1
        (said,) = tracker.warnings()
        assert said.startswith(f'all reflectors jumped together in 1 record, by {jump:+.1f} m')
        # Nothing is taken for a slope, nor for an error of the told depth.
        extras = found[RECORDS * 10**9].extras
        assert extras['dipping'].max() < 0.2
        assert extras['array_depth_found'][0] < 0.05 and extras['heave_std'][0] == 0.0


def test_over_steep_waves_all_keep_their_ids_and_what_dips_is_still_a_slope():
    tracker, _ = tracked(4.0 * np.sin(2.0 * np.pi * np.arange(30) / 25.0))
    assert tracker.warnings() == []
    tracker, found = tracked(0.3 * np.arange(RECORDS) - 4.0)
    newest = found[RECORDS * 10**9]
    assert newest.extras['dipping'].min() > 0.9 and tracker.warnings() == []
    assert newest.extras['slope'] == pytest.approx(0.3, abs=0.03)


def test_a_jump_within_a_gap():
    traces, true = scene(np.zeros(RECORDS), 5, 2.5 * (np.arange(RECORDS) >= AT))
    _, found = run(traces[: AT - 2] + traces[AT + 1 :], **FEWER, record_interval=1.0)
    before, after = found[(AT - 2) * 10**9], found[(AT + 2) * 10**9]
    assert after.state[:, 0] == pytest.approx(true[AT], abs=0.1)
    assert after.extras['track_id'].tolist() == before.extras['track_id'].tolist()


def test_what_is_smoothed_has_the_ids_of_before_the_jump():
    _, found = tracked(3.0 * (np.arange(RECORDS) >= AT), smoothing_lag=2)
    drawn = [found[(k + 1) * 10**9].extras['common_jump'][0] for k in range(RECORDS - 2)]
    assert int(np.argmax(drawn)) == AT


def test_with_heave_there_are_none_and_the_grid_has_a_bound():
    config = FathometerConfig(heave='none')
    jump = common_jump(config, 0.05)
    assert (jump.step, jump.pad * 0.05) == (1, 4.0) and jump.std == pytest.approx(30.0)
    assert common_jump(config, 1.0 / 64.0).step == 4
    assert common_jump(config, 0.5).pad == 8
    for change in ({'common_jump_probability': 0.0}, {'heave': 'independent'}):
        assert common_jump(evolve(config, **change), 0.05) is None
    wide = common_jump(evolve(config, common_jump_std=100.0), 0.01)
    assert wide.reach <= 200 and wide.pad * 0.01 == pytest.approx(267.0, rel=0.01)


def test_what_slopes_explain_is_no_jump():
    config = FathometerConfig()
    slope, common = Slope(0.0, 0.0, 0.16, 1e-4), Common()
    plain, far = (learned(slope, common, 0.02, 1e-4, 1, config, *jump) for jump in ((), (3.0,)))
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
    share, rest = turned / (turned + still), learned(slope, common, 0.0, 1e-4, 1, config).dipping
    assert once.dipping == pytest.approx(slopes * share + (1.0 - slopes) * rest, rel=1e-6)


def test_those_that_are_waited_for_jump_as_well():
    slope = begun(Common(), 1e-4, FathometerConfig())
    known = Identities((Identified(3, 50.0, 0, 0, slope), Identified(5, 60.0, 2, 0, slope)), 6)
    moved = known.moved(-2.0)
    assert [each.depth for each in moved.reflectors] == [48.0, 58.0]
    assert [each.missed for each in moved.reflectors] == [0, 2] and known.moved(0.0) is known
