"""What serializing a message takes: our columns beside the message-wise encoder of mcap-ros2-support.

Both serialize the same values; the exit code is 1 where their bytes differ.
"""

import argparse
import time
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
from mcap_ros2._dynamic import serialize_dynamic
from mcap_ros2.decoder import generate_dynamic
from reader_log import SMALL, START_NS, payloads_of, small_fields

from pipeline.logs import definition_text


def measure(work: Callable[[], list[bytes]]) -> tuple[float, list[bytes]]:
    """Processor time [s] and the payloads."""
    before = time.process_time()
    payloads = work()
    return time.process_time() - before, payloads


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", type=int, default=20_000)


def run(given: argparse.Namespace) -> int:
    """Serialize every kind of message, print the table."""
    differ = False
    print(f"{'us a message':32s} {'ours':>8s} {'mcap-ros2-support':>18s}")
    for kind in sorted({kind for _, kind, _ in SMALL}):
        text = definition_text(kind) or ""
        times = START_NS + np.arange(given.rows) * 10_000_000
        fields = small_fields(kind, times, np.random.default_rng(1))
        ours, payloads = measure(lambda: payloads_of(kind, text, given.rows, fields))  # noqa: B023 - called here
        decode = generate_dynamic(kind, text)[kind]
        messages: list[SimpleNamespace] = [decode(payload) for payload in payloads]
        encode = serialize_dynamic(kind, text)[kind]
        theirs, other = measure(lambda: [encode(message) for message in messages])  # noqa: B023 - called here
        differ |= payloads != other
        print(f"{kind:32s} {ours / given.rows * 1e6:8.2f} {theirs / given.rows * 1e6:18.2f}")
    return int(differ)
