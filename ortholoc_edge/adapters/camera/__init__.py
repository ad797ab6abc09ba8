"""Frames from files, videos and cameras. Images are RGB, uint8, read-only.

A frame that can't be decoded is refused, never repaired: a matcher would find its matches in half a picture.
"""

from ortholoc_edge.adapters.camera.files import FolderSource, VideoSource
from ortholoc_edge.adapters.camera.live import DeviceSource
from ortholoc_edge.adapters.camera.opening import open_source, prepare
from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.pictures import IMAGE_SUFFIXES, read_image
from ortholoc_edge.adapters.camera.source import BadFrameError, Counting, EndOfFrames, FrameSource

__all__ = [
    "IMAGE_SUFFIXES", "BadFrameError", "CameraOptions", "Counting", "DeviceSource", "EndOfFrames", "FolderSource",
    "FrameSource", "VideoSource", "open_source", "prepare", "read_image",
]  # fmt: skip
