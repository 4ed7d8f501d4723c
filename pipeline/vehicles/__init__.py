"""Vehicles and configuration: presets, `run.toml` and `fleet.toml`, and the choice of topics.

A vehicle is geometry and limits. A configuration says what the log cannot say itself. What neither says is
chosen by type and name, with a reason that is printed.
"""

from pipeline.vehicles.configuration import Configuration, DriveSection
from pipeline.vehicles.description import Description, read_description
from pipeline.vehicles.errors import ConfigurationError
from pipeline.vehicles.frames import read_frames
from pipeline.vehicles.loading import list_configuration_files, load_configuration
from pipeline.vehicles.parameters import Controller, apply_parameters, list_metadata, read_parameters
from pipeline.vehicles.presets import Vehicle, find_preset, list_presets, resolve_vehicle
from pipeline.vehicles.recognition import (
    Recognized,
    VehicleSource,
    find_alike,
    list_contradictions,
    make_vehicle,
    recognize_vehicle,
)
from pipeline.vehicles.sources import (
    CONFIGURED,
    DriveForm,
    DriveSource,
    PoseContent,
    PoseSource,
    Signal,
    Sources,
)
from pipeline.vehicles.topics import DEFAULT_INTERVAL, choose_sources
from pipeline.vehicles.units import convert_unit, list_factors
