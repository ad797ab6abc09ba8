"""Exceptions, for what is broken; a frame that gives no fix is a value (`pipeline.outcome.Rejected`).

OrtholocError
├── ConfigError    a configuration file or a command-line value can't be used
├── MapError       an area pack or a raster is missing, damaged or in the wrong reference system
├── ModelError     a matcher's weights or graph can't be obtained, verified or run
├── CameraError    a frame source can't be opened or read
├── LinkError      the connection to the autopilot, or the bus, can't be opened or has ended
└── DatasetError   a recorded sequence or a sample can't be read

Every message names the thing, what is wrong with it, and the remedy.
"""


class OrtholocError(Exception):
    """Base of all errors that this package raises on purpose."""


class ConfigError(OrtholocError):
    """A configuration file or a command-line value can't be used."""


class MapError(OrtholocError):
    """An area pack or a raster is missing, damaged or in the wrong reference system."""


class ModelError(OrtholocError):
    """A matcher's weights or graph can't be obtained, verified or run."""


class CameraError(OrtholocError):
    """A frame source can't be opened or read."""


class LinkError(OrtholocError):
    """The connection to the autopilot, or the bus, can't be opened or has ended."""


class DatasetError(OrtholocError):
    """A recorded sequence or a sample can't be read."""
