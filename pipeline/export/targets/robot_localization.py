"""Wheel odometry for robot_localization: its covariance, and what the filter is to take of it."""

from collections.abc import Collection

import msgspec

from pipeline.export.settings import Amount, Setting, start_sheet
from pipeline.export.settings_text import write_yaml
from pipeline.export.target import Current, Target
from pipeline.models.effect import Effect, Place
from pipeline.models.model_file import ModelFile
from pipeline.models.quantity import Quantity
from pipeline.runs.errors import MotionError

_FILTER = "ekf_filter_node.ros__parameters"
_CONTROLLERS = {
    "differential": ("diff_drive_controller", {Quantity.RADIUS, Quantity.RADIUS_DIFFERENCE, Quantity.TRACK}),
    "ackermann": ("ackermann_steering_controller", {Quantity.RADIUS}),
}
_UNSEEN = {Quantity.STEERING_GAIN, Quantity.STEERING_OFFSET}
"""What encoders on the steering do not see: their own zero and scale."""

_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_STATE = (*_POSE, *(f"v{name}" for name in _POSE), "ax", "ay", "az")
_FUSED = tuple(name in {"vx", "vy", "vyaw"} for name in _STATE)
_INDEPENDENT = (
    "z, roll and pitch are not measured and not fused; errors last about half a second, and a filter that "
    "takes f messages a second for independent is as sure as it should be with 0.5 s * f times as much"
)


def write(file: ModelFile, current: Current) -> str:
    """The parameters as YAML.

    The filter has no parameter for the covariance of a measurement: it comes with the odometry's messages,
    whose controller is given it here. Variances are the squares of the held-out errors over half a second,
    of the best step of the ladder that has only effects which wheel odometry can know. They hold the
    localization's own noise too, so that they are rather too large.

    Raises:
        MotionError: ``wrong_vehicle``; ``not_fitted``, the file has no ladder.
    """
    facts, sheet = start_sheet(file, TARGET, *_CONTROLLERS)
    controller, known = _CONTROLLERS[facts.vehicle.kind]
    step = _find_step(file, known)
    sources = (
        f"squares of the held-out errors over half a second with {', '.join(step.effects) or 'no effect'}",
        "for odometry that is corrected first: --to ros2_control",
        *_warn(file, step, known),
    )
    # Of an error that is known to some per cent more digits would only say from where a fit set out.
    x, y, w = (Amount(float(f"{error * error:.3g}"), sources) for error in step.velocity_rms)
    sheet.settings.append(Setting(f"{_FILTER}.odom0_config", _FUSED, ("vx, vy and the yaw rate of odom0",)))
    acceleration, turning = facts.find_speed_acceleration(), facts.find_turn_acceleration()
    for name in ("acceleration_limits", "deceleration_limits"):
        limits = (acceleration, 0.0, 0.0, 0.0, 0.0, turning)
        sheet.add_row(f"{_FILTER}.{name}", limits, "with use_control: true")
    place = f"{controller}.ros__parameters.twist_covariance_diagonal"
    sheet.add_row(place, (x, y, 0.0, 0.0, 0.0, w), _INDEPENDENT)
    return write_yaml(facts, sheet)


class _Step(msgspec.Struct):
    """What a step of the ladder in a model file says of its errors, x and y in m/s, w in rad/s."""

    effects: list[str]
    velocity_rms: tuple[float, float, float]


def _find_step(file: ModelFile, known: Collection[Quantity]) -> _Step:
    """The last step of the ladder whose effects wheel odometry can follow."""
    try:
        steps = msgspec.convert(file.fit.get("ladder", []), list[_Step])
    except msgspec.ValidationError:
        steps = []
    for step in reversed(steps):
        if all(name in file.model and _is_seen(file.model.effect(name), known) for name in step.effects):
            return step
    what = "the model was never fitted: it has no held-out errors to make a covariance of"
    hint = "Name a log: --on LOG, or fit it first: slip model fit MODEL --on LOG --input measured."
    raise MotionError("not_fitted", what, where="fit.ladder", hint=hint)


def _is_seen(effect: Effect, known: Collection[Quantity]) -> bool:
    """Whether wheel odometry follows what an effect does: encoders show it, or the controller knows it."""
    quantities = {quantity for parameter in effect.parameters for quantity in parameter.quantities}
    if effect.place <= Place.DRIVE:
        return not quantities & _UNSEEN
    return bool(quantities) and quantities <= set(known)


def _warn(file: ModelFile, step: _Step, known: Collection[Quantity]) -> list[str]:
    """What makes the variances larger than they need to be."""
    lines = []
    if file.fit.get("input") != "measured":
        lines.append(
            "fitted on commands; for odometry of encoders: --on LOG, whose measured wheels then count"
        )
    unseen = " ".join(effect.id for effect in file.model if not _is_seen(effect, known))
    if unseen and len(step.effects) < len(file.model.effects):
        lines.append(f"odometry does not follow {unseen}; sharper: slip model drop MODEL {unseen} --on LOG")
    return lines


TARGET = Target(
    "robot_localization",
    "the covariance of wheel odometry for robot_localization",
    "cra-ros-pkg/robot_localization 3.6, params/ekf.yaml and preparing_sensor_data.rst; the filter takes "
    "covariances from the messages, which ros-controls/ros2_controllers fills from twist_covariance_diagonal",
    write,
    has_errors=True,
)
