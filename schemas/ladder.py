"""Held-out errors of the ideal model, then with one effect more at each rung; and the noise floor."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table

KINDS = ("rung", "floor")


class Ladder(Table):
    """One row a rung; the last row of an input is its noise floor."""

    VERSION: ClassVar[int] = 1

    input = fields.source("what the model was fed with")
    kind = fields.choice(KINDS, "a model, or how well motion repeats itself")
    rung = dy.Int32(min=0, metadata={"description": "place on the ladder; 0 is the ideal model"})
    added = fields.text("effects that this rung adds")
    effects = fields.text("all effects of this rung, in the order of a command's way")
    rms_x = fields.body("m/s", "rms of displacement over 0.5 s, over 0.5 s: forward", nullable=True)
    rms_y = fields.body("m/s", "the same to the left", nullable=True)
    rms_w = fields.body("rad/s", "the same of the heading", nullable=True)
    t_mrmse = fields.optional("m", "rms position error over windows and steps of 2 s")
    r_mrmse = fields.optional("rad", "rms wrapped yaw error over windows and steps of 2 s")
    explained_share = fields.optional("1", "share of the removable error that is gone")
