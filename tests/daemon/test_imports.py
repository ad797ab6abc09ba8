"""What the flying process does not load unless it is used."""

from __future__ import annotations

import subprocess
import sys


def test_zenoh_is_not_loaded_while_the_bus_is_off() -> None:
    code = "import sys, ortholoc_edge.daemon; sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
