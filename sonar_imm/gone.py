# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names that earlier versions had, and what a user does instead.

One version long, each removed command, kind of conversion, parameter, choice and program answers
with its sentence instead of "unknown". Keys are ``command NAME``, ``kind NAME``,
``parameter NAME``, ``choice PARAMETER VALUE``, ``executable NAME`` and ``option COMMAND NAME``.
"""

from __future__ import annotations

__all__ = ['GONE']

_BRIDGE = 'was removed: republish ~/odometry or ~/obstacles with a node of your own'
_WITH_ITS_SET = 'was removed together with its model set'
_ROLL = 'was removed: use the elevation of the echoes, or let the vehicle roll'
_OWN_SET = 'was removed: families contains constant velocity; docs/howto/own_model.md adds a set'
_CONSTANT = 'was removed: its default is a constant now'
_LIFE = 'was removed: obstacles live by confirm_existence; for divers its default is a constant'
_OF_TARGET = (
    'was removed: a preset has it (parameter target); a set of your own models may differ, see '
    'docs/howto/own_model.md'
)
_TYPE = 'was removed: name it in input_types, e.g. "fix=geometry_msgs/msg/PointStamped"'
_RAW_FILE = 'was removed: convert the file to npz (kind snapshots) or to XTF'
_LIVE_VIEW = (
    'was removed: view opens the report; show live topics with foxglove_bridge and '
    'config/foxglove_SYSTEM.json'
)

GONE: dict[str, str] = {
    'command fuse': 'was removed: give both sensors to one diver node (parameter sensors)',
    'command chart': 'was removed: record ~/soundings and run sonar-imm survey',
    'command sweep': 'was removed: use sonar-imm simulate --seed, track --jobs and evaluate',
    'option warm --jobs': 'was removed: one process compiles all kernels',
    'kind ek80': _RAW_FILE,
    'kind kongsberg': _RAW_FILE,
    'kind autoferry': 'was removed: write the positions as CSV (kind fixes)',
    'executable composed_node': 'was removed: start one process per node',
    **{f'parameter {name}': _BRIDGE for name in ('targets_to', 'targets_as', 'targets_period')},
    'parameter also_publish': _BRIDGE,
    **{
        f'parameter {name}': _WITH_ITS_SET
        for name in (
            *('lateral_speed_std', 'lateral_speed_time', 'fixed_speed', 'velocity_noise'),
            *('turn_rate_deg', 'baseline_stay_probability'),
        )
    },
    **{
        f'choice model_set {name}': _OWN_SET
        for name in (
            *('cv', 'cv_cv', 'cv_ct', 'world_headings', 'relative_headings'),
            'heading_speed_lateral',
        )
    },
    **{
        f'parameter {name}': _OF_TARGET
        for name in (
            *('hover', 'hover_enter', 'hover_stay', 'hover_noise', 'heading_concentration'),
            *('lateral_noise', 'brisk_speed_noise', 'velocity_std', 'family_switch_rate'),
            *('vertical_speed_std', 'vertical_speed_time'),
        )
    },
    **{
        f'parameter origin_{part}': 'was removed: give origin [latitude, longitude, height]'
        for part in ('latitude', 'longitude', 'height')
    },
    'parameter sweep_speed': 'was removed: each direction counts at its own time',
    'parameter publish_revisions': 'was removed: max_revisions 0 leaves revisions out',
    'parameter queue_depth': 'was removed: set qos_overrides.TOPIC.subscription.depth',
    'parameter diagnostics_period': _CONSTANT,
    'parameter state_interval': _CONSTANT,
    'parameter use_tf_static': 'was removed: remap /tf_static for a node that must not hear it',
    **{
        f'parameter {name}_type': _TYPE
        for name in (
            *('fix', 'fixes', 'relative', 'nav_fix', 'heading', 'altitude', 'detections'),
            *('array_depth', 'tf_static', 'image'),
        )
    },
    **{
        f'parameter {name}': _CONSTANT
        for name in (
            *('adaptation', 'adaptation_prior', 'adaptation_guard', 'reference_step'),
            *('longest_step', 'transceiver_lever_std', 'vessel_attitude_std_deg'),
            *('vessel_max_gap', 'vessel_max_extrapolation', 'fix_bias_time', 'survival_time'),
            *('confirm_hits', 'gate_probability'),
            *('max_gap', 'restart_after'),
            *('components', 'sway_time', 'speed_noise', 'behaviour_time', 'seabed_std'),
            *('ground_std', 'ground_radius', 'max_offset', 'altitude_std'),
            *('max_altitude_age', 'scale_std', 'course_window', 'landmark_time'),
            'max_navigation_gap',
            *(
                'sigma_reference_bin',
                'initial_slope_std',
                'redrawn_slope_std',
                'multipath_level_db',
                'likelihood',
            ),
            *('initial_mean', 'initial_std'),
            'max_extrapolation',
            *('array_depth_age', 'heave_memory', 'white_noise_gain_db', 'depth_step'),
            *('slope_switch_probability', 'negative_probability', 'amplitude_memory'),
            'track_memory',
            *('training', 'training_beams', 'guard', 'growth_false_alarm', 'sweep_max_gap'),
            *('phone_least_share', 'fish_rate', 'bottom_jump', 'detectable_sigmas'),
        )
    },
    'parameter false_alarm': (
        'was removed: set threshold_margin_db; 1e-3 was 3 dB below the default, 1e-9 1.8 dB above'
    ),
    'parameter remove_background': 'was removed: envelopes are found (parameter water)',
    **{f'parameter {name}': _LIFE for name in ('confirm_window', 'delete_misses')},
    'parameter sector_edge_deg': 'was removed: the edges of the beam are smeared by 1.2 degrees',
    'parameter outlier_probability': (
        'was removed: an echo that is not of an obstacle is clutter (parameter clutter_density)'
    ),
    'parameter systematic_errors': (
        'was removed: state how good instruments are; that they are exact says 1e-6 '
        '(parameter sound_speed_std)'
    ),
    'parameter fixes_are_scans': 'was removed: set -1 where it was false (parameter scan_period)',
    'parameter map_frame': 'was removed: the frame of the input is this one (parameter frame_id)',
    'parameter least_covariance_scale': 'was removed: state the covariances as they are',
    'parameter estimate_covariance_scale': (
        'was removed: set the factor of the warning (parameter covariance_scale)'
    ),
    **{
        f'parameter sensor_{name}': f'was removed: write <sensor>.{name} (parameter sensors)'
        for name in (
            *('fix_std', 'detection_probability', 'clutter_density'),
            *('coverage_sector', 'coverage_file'),
        )
    },
    'parameter hypotheses': 'was removed together with association: kbest',
    'parameter named_tracks': 'was removed: a track with a name also takes fixes without one',
    **{
        f'choice model_set {name}': (
            'was removed: terrain, the default, maps these floors; what this set called rough is '
            'rough + prob_winding there'
        )
        for name in ('height_bank', 'scatter_bank')
    },
    'parameter engine': 'was removed: each set has one (parameter model_set)',
    **{
        f'parameter grid_{name}': 'was removed: no model set runs on a grid (parameter model_set)'
        for name in ('step', 'extent')
    },
    'parameter shadow_gate': 'was removed: 1 is no gate (parameter gate_false_alarm)',
    **{
        f'parameter {name}': 'was removed: terrain, the default, has models of rough floor'
        for name in ('rough_sigma', 'scatters')
    },
    'choice association kbest': (
        'was removed: jipda, the default, weighs all joint events of a scan exactly'
    ),
    'parameter method': 'was removed: behaviours [fixed, seabed] keeps what lies on the sea floor',
    'parameter seed': 'was removed: this tracker draws no random numbers',
    'parameter range_step': 'was removed: it is part of range_std',
    'parameter bearing_step_deg': 'was removed: it is part of bearing_std_deg',
    **{
        f'parameter {name}': 'was removed: give detection_profile [range, share, range, share]'
        for name in ('detection_ranges', 'detection_factors')
    },
    **{
        f'parameter {name}': 'was removed: choose navigation_grade (ins, dvl or dead_reckoning)'
        for name in ('position_noise', 'yaw_noise_deg', 'depth_noise')
    },
    **{
        f'parameter {name}': (
            'was removed: scatter below the floor of an envelope is found (parameter water)'
        )
        for name in ('scatter_decay', 'scatter_spread')
    },
    'parameter variant': 'was removed: the printed form is in benchmarks/bathymetry_paper.py',
    **{
        f'parameter {name}': 'was removed: the printed form is in benchmarks/fathometer_paper.py'
        for name in ('amplitude_prior', 'proposal', 'output', 'envelope')
    },
    'parameter multiples': 'was removed: they are always marked (column multiple_probability)',
    **{
        f'parameter {name}': _ROLL
        for name in ('vertical_beam_width_deg', 'fading_db', 'intensity_weight')
    },
    **{
        f'option view {name}': _LIVE_VIEW
        for name in (
            *('--live', '--host', '--port', '--layout', '--loop', '--rate', '--topics'),
            '--start-paused',
        )
    },
}
"""What each removed name answers, after the name itself."""
