"""What can be wrong with a vehicle or a configuration."""

from pipeline.core.errors import SlipError


class ConfigurationError(SlipError):
    """A configuration that cannot be used, or a choice that must be made by the user."""
