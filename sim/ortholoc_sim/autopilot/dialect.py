"""MAVLink as the simulated autopilot speaks it: pymavlink's own codec, not the daemon's parser."""

from __future__ import annotations

import os
from typing import Any

os.environ["MAVLINK20"] = "1"

from pymavlink.dialects.v20 import ardupilotmega as dialect

__all__ = ["Message", "dialect"]

# A message of pymavlink's dialect, which carries no types.
Message = Any
