"""Seconds to an answer by protocol, as the benchmark of plans prints them."""

from __future__ import annotations

import math

import pytest
from plan_compare import PROTOCOLS, report


@pytest.mark.parametrize(
    ("plan", "drive", "ratio"),
    [
        ((10.0, 10.0, 10.0), (20.0, 30.0, 40.0), "3.0"),
        # A draw that the plan does not answer counts as well: it is 150 s against 30 s.
        ((10.0, math.inf, math.inf), (30.0, 30.0, 30.0), "0.2"),
        ((10.0, 10.0, 10.0), (math.inf, math.inf, 20.0), "15.0"),
        ((math.inf, math.inf, math.inf), (math.inf, math.inf, math.inf), "1.0"),
    ],
)
def test_the_ratio_counts_every_draw_as_at_most_the_time_driven(
    plan: tuple[float, ...], drive: tuple[float, ...], ratio: str, capsys: pytest.CaptureFixture[str]
) -> None:
    report(
        [
            {"target": "lag", **dict.fromkeys(PROTOCOLS, 1.0), "plan": mine, "DRIVE": other}
            for mine, other in zip(plan, drive, strict=True)
        ]
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines if line.startswith(("lag", "all"))] == [ratio, ratio]
