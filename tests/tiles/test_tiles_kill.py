import sys

import pytest
from kill_loop import kill_loop

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc and renameat2")


@pytest.mark.parametrize("two_steps", [False, True])
def test_killed_build_leaves_the_old_pack_or_the_new(tmp_path, two_steps):
    # A process of its own for a build's work is killed in one of the two; the steps are the same with and without.
    seen = kill_loop(tmp_path, 2, seed=1, two_steps=two_steps, jobs=1 if two_steps else 2)
    assert seen["group killed"] + seen["parent killed"] == 2
