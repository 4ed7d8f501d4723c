"""Motion models: what the body velocity is, given the wheels.

So far the ideal ones, in which nothing slips: differential drive and kinematic bicycle.
"""

from pipeline.motion.ideal import (
    invert_ackermann,
    invert_differential,
    predict_ackermann,
    predict_differential,
)

__all__ = ["invert_ackermann", "invert_differential", "predict_ackermann", "predict_differential"]
