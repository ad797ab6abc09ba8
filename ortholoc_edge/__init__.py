"""OrthoLoC Edge: where the vehicle is, from a camera, an orthophoto and a surface model."""

__version__ = "0.1.0"
