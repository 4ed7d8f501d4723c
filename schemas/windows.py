"""Slip over windows of two seconds, the quantity of the published figure."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table


class Windows(Table):
    """One row a full window; windows start where a segment or a command step starts."""

    VERSION: ClassVar[int] = 1

    input = fields.source()
    t_start = fields.seconds("start of the window")
    t_end = fields.seconds("end of the window")
    segment = fields.segment()
    step = fields.step()
    transitory = fields.flag("most of the window lies in the transitory span of a change of command")
    suspect = fields.flag("in a stretch with a rotated heading or a frozen position; left out of medians")
    samples = dy.Int32(min=1, metadata={"description": "grid steps in the window"})
    rms_modulus = fields.bounded("m/s", "root mean square of the slip modulus", 0.0)
    window_norm = fields.bounded("m/s", "sqrt(40) rms_modulus: the published 2 s window norm", 0.0)
