"""Frozen values and pure functions of numpy; no I/O, no logging. Conventions: docs/frames.md."""
