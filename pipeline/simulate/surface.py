"""The surface of the ground: a plane with hills."""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.rigid import quaternions_from_euler, rotate
from pipeline.simulate.scenario import Ground

Vector = tuple[float, float, float]

_WAVES = 6


@dataclass(frozen=True)
class Surface:
    """Height h(x, y) = slope_x x + slope_y y + sum of a sin(p x + q y + c).

    Attributes:
        slope_x, slope_y: gradient of the plane.
        waves: (a [m], p [1/m], q [1/m], c [rad]) of each wave.
    """

    slope_x: float
    slope_y: float
    waves: tuple[tuple[float, float, float, float], ...]

    def height_at(self, x: float, y: float) -> float:
        """Height [m] of the ground at a place [m]."""
        height = self.slope_x * x + self.slope_y * y
        for size, p, q, phase in self.waves:
            height += size * math.sin(p * x + q * y + phase)
        return height

    def normal_at(self, x: float, y: float) -> Vector:
        """Unit normal of the ground at a place [m], pointing up."""
        slope_x, slope_y = self.slope_x, self.slope_y
        for size, p, q, phase in self.waves:
            change = size * math.cos(p * x + q * y + phase)
            slope_x += change * p
            slope_y += change * q
        scale = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        return -slope_x * scale, -slope_y * scale, scale


def make_surface(ground: Ground, generator: np.random.Generator) -> Surface:
    """Draw the hills of a ground; wavelengths spread by a factor of two about the asked one."""
    up_x, up_y, up_z = rotate(tilt_quaternion(ground), np.array([0.0, 0.0, 1.0])).tolist()
    waves: list[tuple[float, float, float, float]] = []
    if ground.hill_m > 0.0:
        size = ground.hill_m * math.sqrt(2.0 / _WAVES)
        for direction, stretch, phase in zip(
            generator.uniform(0.0, math.pi, _WAVES).tolist(),
            (2.0 ** generator.uniform(-0.5, 0.5, _WAVES)).tolist(),
            generator.uniform(0.0, 2.0 * math.pi, _WAVES).tolist(),
            strict=True,
        ):
            number = 2.0 * math.pi / (ground.hill_length_m * stretch)
            waves.append((size, number * math.cos(direction), number * math.sin(direction), phase))
    return Surface(-up_x / up_z, -up_y / up_z, tuple(waves))


def tilt_quaternion(ground: Ground) -> Floats:
    """Attitude, shape (4,), of the plane that the hills stand on."""
    tilt: Floats = quaternions_from_euler(
        np.array([ground.roll_rad]), np.array([ground.pitch_rad]), np.array([0.0])
    )[0]
    return tilt


def cross(first: Vector, second: Vector) -> Vector:
    """Cross product of two vectors, in plain floats because it runs at every step."""
    return (
        first[1] * second[2] - first[2] * second[1],
        first[2] * second[0] - first[0] * second[2],
        first[0] * second[1] - first[1] * second[0],
    )


def slide_onto_plane(vector: Vector, normal: Vector) -> Vector:
    """The unit vector nearest to ``vector`` that lies in the plane of ``normal``."""
    lift = vector[0] * normal[0] + vector[1] * normal[1] + vector[2] * normal[2]
    x, y, z = (vector[i] - lift * normal[i] for i in range(3))
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale
