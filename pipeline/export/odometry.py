"""Noise of wheel odometry: the covariance for robot_localization, and AMCL's alphas."""

from collections.abc import Collection

import msgspec

from pipeline.export import (
    Amount,
    Facts,
    ParameterTable,
    Setting,
    Target,
    require_plausible,
)
from pipeline.models import Effect, ModelFile, Place, Quantity
from pipeline.run import MotionError

_FILTER = "ekf_filter_node.ros__parameters"
_CONTROLLERS = {
    "differential": ("diff_drive_controller", {Quantity.RADIUS, Quantity.RADIUS_DIFFERENCE, Quantity.TRACK}),
    "ackermann": ("ackermann_steering_controller", {Quantity.RADIUS, Quantity.WHEELBASE}),
}
_UNSEEN = {Quantity.STEERING_GAIN, Quantity.STEERING_OFFSET}
"""Quantities that encoders on the steering do not measure: their own offset and scale."""

_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_STATE = (*_POSE, *(f"v{name}" for name in _POSE), "ax", "ay", "az")
_FUSED = tuple(name in {"vx", "vy", "vyaw"} for name in _STATE)
_INDEPENDENT = (
    "z, roll and pitch are neither measured nor fused; errors are correlated over about half a second, so "
    "multiply the covariance by 0.5 s * f for a filter that takes f messages a second as independent"
)


def _add_covariance(facts: Facts, table: ParameterTable) -> None:
    """Add the covariance of the odometry.

    The filter has no parameter for the covariance of a measurement: it comes with the odometry messages,
    whose controller gets it here. Variances are the squares of the held-out errors over half a second, from
    the last step of the ladder whose effects are all known to wheel odometry. They include the localization's
    own noise, so they are too large rather than too small.

    Raises:
        MotionError: ``not_fitted``, the file has no ladder.
    """
    file = facts.file
    controller, known = _CONTROLLERS[facts.vehicle.kind]
    step = _find_step(file, known)
    sources = (
        f"squares of the held-out errors over half a second with {', '.join(step.effects) or 'no effect'}",
        "for odometry that is corrected first: --to ros2_control",
        *_warn(file, step, known),
    )
    # The error is known to some per cent; more digits would only reflect the starting values of the fit.
    x, y, w = (Amount(float(f"{error * error:.3g}"), sources) for error in step.velocity_rms)
    table.settings.append(Setting(f"{_FILTER}.odom0_config", _FUSED, ("vx, vy and the yaw rate of odom0",)))
    acceleration, turning = facts.find_speed_acceleration(), facts.find_turn_acceleration()
    for name in ("acceleration_limits", "deceleration_limits"):
        limits = (acceleration, 0.0, 0.0, 0.0, 0.0, turning)
        table.add_row(f"{_FILTER}.{name}", limits, "with use_control: true")
    key = f"{controller}.ros__parameters.twist_covariance_diagonal"
    table.add_row(key, (x, y, 0.0, 0.0, 0.0, w), _INDEPENDENT)


class _Step(msgspec.Struct):
    """Errors of a step of the ladder in a model file: x and y in m/s, w in rad/s; and AMCL's alphas."""

    effects: list[str]
    velocity_rms: tuple[float, float, float]
    odometry_alphas: tuple[float, float, float, float] | None = None


def _find_step(file: ModelFile, known: Collection[Quantity]) -> _Step:
    """The last step of the ladder whose effects wheel odometry can follow."""
    try:
        steps = msgspec.convert(file.fit.get("ladder", []), list[_Step])
    except msgspec.ValidationError:
        steps = []
    for step in reversed(steps):
        require_plausible("fit.ladder.velocity_rms", *step.velocity_rms, least=0.0)
        if all(name in file.model and _is_seen(file.model.effect(name), known) for name in step.effects):
            return step
    what = "the model was never fitted: it has no held-out errors to make a covariance of"
    hint = "Name a log: --on LOG, or fit it first: slip model fit MODEL --on LOG --input measured."
    raise MotionError("not_fitted", what, where="fit.ladder", hint=hint)


def _is_seen(effect: Effect, known: Collection[Quantity]) -> bool:
    """Whether wheel odometry includes an effect: encoders measure it, or the controller models it."""
    quantities = {quantity for parameter in effect.parameters for quantity in parameter.quantities}
    if effect.place <= Place.DRIVE:
        return not quantities & _UNSEEN
    return bool(quantities) and quantities <= set(known)


def _warn(file: ModelFile, step: _Step, known: Collection[Quantity]) -> list[str]:
    """Reasons why the variances are larger than necessary."""
    lines = []
    if file.fit.get("input") != "measured":
        lines.append("fitted from commands; for wheel odometry give --on LOG, which fits from wheel encoders")
    unseen = " ".join(effect.id for effect in file.model if not _is_seen(effect, known))
    if unseen and len(step.effects) < len(file.model.effects):
        lines.append(f"odometry does not follow {unseen}; sharper: slip model drop MODEL {unseen} --on LOG")
    return lines


ROBOT_LOCALIZATION = Target(
    "robot_localization",
    "the covariance of wheel odometry for robot_localization",
    "cra-ros-pkg/robot_localization 3.6, params/ekf.yaml and preparing_sensor_data.rst; the filter takes "
    "covariances from the messages, which ros-controls/ros2_controllers fills from twist_covariance_diagonal",
    tuple(_CONTROLLERS),
    complete=_add_covariance,
    has_errors=True,
)


_AMCL = "amcl.ros__parameters"


def _add_alphas(facts: Facts, table: ParameterTable) -> None:
    """Add the noise of the odometry that AMCL moves its particles by.

    Raises:
        MotionError: ``not_fitted``, the file has no ladder, or none of measured wheels.
    """
    file = facts.file
    known = _CONTROLLERS[facts.vehicle.kind][1]
    step = _find_step(file, known)
    if step.odometry_alphas is None:
        what = "the model has no errors of wheel odometry: they are measured on a log"
        hint = "Name a log with measured wheels: --on LOG."
        raise MotionError("not_fitted", what, where="fit.ladder", hint=hint)
    sources = (
        f"held-out errors of odometry over 2 s with {', '.join(step.effects) or 'no effect'}",
        *_warn(file, step, known),
    )
    notes = (
        "variance of each turn per square of the turn",
        "variance of each turn per square of the way [rad^2/m^2]",
        "variance of the way per square of the way",
        "variance of the way per square of the turns [m^2/rad^2]",
    )
    for number, (alpha, note) in enumerate(zip(step.odometry_alphas, notes, strict=True), start=1):
        table.add(f"{_AMCL}.alpha{number}", Amount(float(f"{alpha:.3g}"), (note, *sources)))
    for name, least in (("update_min_d", UPDATE_M), ("update_min_a", UPDATE_RAD)):
        table.add(f"{_AMCL}.{name}", Amount(least, ("the alphas are those of updates after this motion",)))


UPDATE_M, UPDATE_RAD = 0.25, 0.2
"""Motion after which AMCL updates its particles by default [m, rad]: its noise is added once an update."""

NAV2_AMCL = Target(
    "nav2_amcl",
    "AMCL's noise of wheel odometry",
    "ros-navigation/navigation2 1.5 (Lyrical), nav2_amcl: alpha1 to alpha4 of the differential motion model "
    "(Thrun, Burgard and Fox, Probabilistic Robotics, table 5.6)",
    tuple(_CONTROLLERS),
    complete=_add_alphas,
    has_errors=True,
)
