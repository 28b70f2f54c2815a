"""A small real system, the walker, and a bench to run its node on: one process, one executor."""

from collections import Counter
import contextlib
import time

import attrs
import numpy as np
import pytest

from msg_adapters.inputs import INPUTS
from sonar_imm.estimates import Estimate
from sonar_imm.parameters import Config, parameter
from sonar_imm.trackers import System, SYSTEMS

rclpy = pytest.importorskip('rclpy')


@attrs.frozen(kw_only=True)
class WalkerConfig(Config):
    """A walker who stays where he is, and one that is slow or fast."""

    sound_speed: float = parameter(1500.0, 'speed of sound', unit='m/s', low=1300.0, high=1700.0,
                                   read_only=False)
    fast_share: float = parameter(0.25, 'share of fast', low=0.0, high=1.0, read_only=False)
    slow_share: float = parameter(0.75, 'share of slow', low=0.0, high=1.0, read_only=False)
    steps: int = parameter(3, 'steps', low=1, high=9)
    mood: str = parameter('calm', 'mood', choices=('calm', 'hasty'), read_only=False)
    weights: tuple = parameter((), 'weights', kind='float[]', low=0.0, high=1.0, read_only=False)
    offsets: tuple = parameter((0.5, 1.5), 'offsets', unit='m', low=-9.0, high=9.0)

    def check(self):
        if abs(self.fast_share + self.slow_share - 1.0) > 1e-9:
            return ['fast_share and slow_share must sum to 1']
        return []


class WalkerTracker:
    """The running mean of the fixes, in the order of their stamps; late ones revise it."""

    def __init__(self, config):
        self.config = config
        self.counts = Counter()
        self.explode = False
        self.reset()

    def reset(self):
        self.fixes = {}

    def reconfigure(self, config):
        self.config = config

    def warm(self):
        pass

    def health(self):
        return {'NIS': 1.25, 'tracks': float(bool(self.fixes))}

    def process(self, measurement):
        if self.explode:
            raise ZeroDivisionError('a bug')
        if measurement.stamp_ns in self.fixes:
            self.counts['duplicate'] += 1
            return []
        self.counts['used'] += 1
        self.fixes[measurement.stamp_ns] = measurement
        return [self._estimate(stamp) for stamp in sorted(self.fixes)
                if stamp >= measurement.stamp_ns]

    def _estimate(self, stamp):
        used = [fix.position for key, fix in self.fixes.items() if key <= stamp]
        x, y, z = np.mean(used, axis=0)
        return Estimate(
            stamp_ns=stamp, frame_id=self.fixes[stamp].frame_id,
            xyz=np.array([[x, y, z]] * 2, np.float32),
            state_names=('px', 'py', 'vx', 'vy'), state=np.array([[x, y, 0.5, -0.25]] * 2),
            covariance=np.stack([np.diag([1.0, 2.0, 3.0, 4.0])] * 2),
            model_names=('slow', 'fast'),
            probabilities=np.array([[self.config.slow_share, self.config.fast_share]] * 2),
            extras={'track_id': np.array([7, 4], np.uint32),
                    'track_state': np.array([1, 2], np.uint8), 'nis': np.full(2, 0.5)})


class WalkerSystem(System):
    """The walker, known by its classes instead of their names."""

    def config_type(self):
        return WalkerConfig

    def build(self, config):
        return WalkerTracker(config)


@pytest.fixture
def walker(monkeypatch):
    """Make the system 'walker' known; it hears what the diver tracker hears."""
    monkeypatch.setitem(SYSTEMS, 'walker', WalkerSystem('walker', '', '', '', 'test system'))
    monkeypatch.setitem(INPUTS, 'walker', INPUTS['diver'])


class Bench:
    """A context of its own with a peer node, and an executor to spin everything on."""

    def __init__(self, args=()):
        self.context = rclpy.Context()
        rclpy.init(args=['bench', '--ros-args', *args] if args else None, context=self.context,
                   signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.nodes = []
        self.peer = self.add(rclpy.node.Node('peer', context=self.context,
                                             use_global_arguments=False))

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def spin_until(self, predicate, limit=10.0):
        """Spin until `predicate()` is true; fails the test after `limit` seconds."""
        end = time.monotonic() + limit
        while not predicate():
            assert time.monotonic() < end, 'what was waited for did not happen'
            self.executor.spin_once(timeout_sec=0.02)

    def listen(self, message_type, topic, qos=10):
        """Collect what comes on `topic`."""
        heard = []
        self.peer.create_subscription(message_type, topic, heard.append, qos)
        return heard

    def call(self, service_type, name, request):
        client = self.peer.create_client(service_type, name)
        self.spin_until(client.service_is_ready)
        future = client.call_async(request)
        self.spin_until(future.done)
        return future.result()

    def close(self):
        for node in self.nodes:
            node.destroy_node()
        self.executor.shutdown()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def make_bench():
    """Make benches, each with ROS arguments as on a command line; all are closed at the end."""
    with contextlib.ExitStack() as stack:
        def make(*args):
            bench = Bench(args)
            stack.callback(bench.close)
            return bench
        yield make
