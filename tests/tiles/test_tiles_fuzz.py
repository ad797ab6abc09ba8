import os

from fuzz_builds import fuzz

# More of it: ORTHOLOC_EDGE_FUZZ=2000, or python tests/tiles/fuzz_builds.py 2000
CASES = int(os.environ.get("ORTHOLOC_EDGE_FUZZ", "80"))


def test_damaged_inputs_give_named_errors(tmp_path):
    seen, found = fuzz(tmp_path, CASES, seed=1)
    assert found == [], "\n".join(found)
    assert sum(seen.values()) == CASES
    assert seen["dop: refused"] > 0 and seen["manifest: refused"] > 0
