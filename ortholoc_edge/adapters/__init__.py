"""One module per thing outside the process: camera, autopilot, bus, files."""
