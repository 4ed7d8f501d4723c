"""Stamps that are too coarse for the rate of a topic are no times of its messages."""

import numpy as np
import pytest

from pipeline.recording.clocks import Recorded, align_clocks
from pipeline.words import format_finding

LOG = 1_720_000_000 * 10**9 + np.arange(2000) * 50_000_000
EXACT = LOG - 10_000_000


def align(header: np.ndarray, clock: str | None = None) -> tuple[str, np.ndarray, list[str]]:
    recorded = {
        "pose": Recorded("/pose", LOG, LOG, EXACT),
        "wheels": Recorded("/joint_states", LOG, LOG, header, clock),
    }
    clocks, findings = align_clocks(recorded)
    said = [format_finding(one) for one in findings if one.id == "coarse_stamps"]
    return clocks["wheels"].clock, clocks["wheels"].stamp - LOG, said


@pytest.mark.parametrize(("tick_s", "said"), [(1.0, "whole seconds"), (0.5, "0.5 s"), (0.2, "0.2 s")])
@pytest.mark.parametrize("origin_s", [0, -1_719_999_963], ids=["the day's", "since boot"])
def test_a_coarse_clock_is_no_clock(tick_s: float, said: str, origin_s: int) -> None:
    tick = round(tick_s * 1e9)
    clock, apart, (text,) = align((EXACT + origin_s * 10**9) // tick * tick)
    assert clock == "log"
    assert said in text
    assert "log times" in text
    assert np.abs(apart + 10_000_000).max() <= 10_000_000


def test_decimals_of_a_double_are_as_coarse() -> None:
    seconds = np.round(EXACT / 1e9, 0) + 1e-7
    assert align(np.round(seconds * 1e9).astype(np.int64))[0] == "log"


def test_stamps_that_tell_messages_apart_are_kept() -> None:
    assert align(EXACT)[0] == "header"
    # Steps of 0.05 s are those of the topic itself; repeated readings carry odd stamps.
    assert align(EXACT // 50_000_000 * 50_000_000)[0] == "header"
    repeated = np.repeat(EXACT[::4] + np.arange(500) * 1237 % 30_000_000, 4)
    assert align(repeated)[0] == "header"
    assert align(EXACT // 10**9 * 10**9, "header")[0] == "header"
