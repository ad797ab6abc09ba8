"""What the flying process does not load unless it is used."""

from __future__ import annotations

import subprocess
import sys


def test_zenoh_is_not_loaded_while_the_bus_is_off() -> None:
    code = "import sys, ortholoc_edge.daemon; sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_page_is_not_loaded_while_it_is_off_and_brings_no_library_when_it_is_on() -> None:
    code = """
import sys, ortholoc_edge.daemon
assert "ortholoc_edge.adapters.page.ground_page" not in sys.modules
before = set(sys.modules)
import ortholoc_edge.adapters.page.ground_page
new = {name.split(".")[0] for name in set(sys.modules) - before}
sys.exit(str(new) if new & {"ssl", "http", "email", "asyncio", "socketserver", "html"} else 0)
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
