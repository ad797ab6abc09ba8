"""``python -m ortholoc_edge``."""

import sys

from ortholoc_edge.cli import main

if __name__ == "__main__":
    sys.exit(main())
