"""Vehicles and configuration: presets, `run.toml` and `fleet.toml`, and the choice of topics.

A vehicle is geometry and limits. A configuration adds what the log does not contain. Anything else is chosen
by type and name, with a reason that is printed.
"""

from pipeline.sources.candidates import (
    CONFIGURED,
    DriveForm,
    DriveSource,
    PoseContent,
    PoseSource,
    Signal,
    Sources,
)
from pipeline.sources.configuration import (
    Configuration,
    ConfigurationError,
    DriveSection,
    Vehicle,
    convert_unit,
    find_preset,
    list_factors,
    list_presets,
    resolve_vehicle,
)
from pipeline.sources.loading import list_configuration_files, load_configuration
from pipeline.sources.recognition import (
    Controller,
    Description,
    Recognized,
    VehicleSource,
    apply_parameters,
    find_alike,
    list_contradictions,
    list_metadata,
    make_vehicle,
    read_description,
    read_frames,
    read_parameters,
    recognize_vehicle,
)
from pipeline.sources.topics import DEFAULT_INTERVAL, choose_sources
