"""Where on Earth a place of the simulated world is: WGS84, the world's origin being a field in Quebec."""

import numpy as np

from pipeline.core.arrays import Floats

ORIGIN_DEG = (46.78, -71.27)
_ALTITUDE_M = 90.0
_A_M = 6378137.0
_B_M = 6356752.314245
_ROUNDS = 6


def to_earth(position: Floats) -> tuple[Floats, Floats, Floats]:
    """Latitude and longitude [deg] and altitude over the ellipsoid [m], each (n,), of places (n, 3) [m].

    Args:
        position: east, north and up of the origin.
    """
    lat, lon = np.radians(ORIGIN_DEG)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.cross(up, east)
    centre = _of_geodetic(float(lat), float(lon), _ALTITUDE_M)
    x, y, z = (centre + position @ np.stack((east, north, up))).T
    ring = np.hypot(x, y)
    squeeze = (_B_M / _A_M) ** 2
    latitude = np.arctan2(z, squeeze * ring)
    altitude = np.zeros_like(ring)
    for _ in range(_ROUNDS):
        normal = _A_M**2 / np.hypot(_A_M * np.cos(latitude), _B_M * np.sin(latitude))
        altitude = ring / np.cos(latitude) - normal
        latitude = np.arctan2(z, ring * (squeeze * normal + altitude) / (normal + altitude))
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude


def _of_geodetic(lat: float, lon: float, altitude: float) -> Floats:
    normal = _A_M**2 / np.hypot(_A_M * np.cos(lat), _B_M * np.sin(lat))
    ring = (normal + altitude) * np.cos(lat)
    height = ((_B_M / _A_M) ** 2 * normal + altitude) * np.sin(lat)
    return np.array([ring * np.cos(lon), ring * np.sin(lon), height])
