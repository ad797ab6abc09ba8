"""Each of the paper's matchers with random weights: the published network exported, compared with its own code, run by
the matcher, and asked for a pose. They find nothing, so what counts is that each call ends as the contract says."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from replay import rendered

torch = pytest.importorskip("torch", reason="needs the extra 'export': `.ci/export` installs it")

from ortholoc_edge.errors import ModelError  # noqa: E402
from ortholoc_edge.export.build import Order, build  # noqa: E402
from ortholoc_edge.export.sources import vismatch  # noqa: E402
from ortholoc_edge.matching import exported, models, pairs  # noqa: E402
from ortholoc_edge.matching.exported import EXPORTED  # noqa: E402
from ortholoc_edge.matching.registry import make_matcher  # noqa: E402
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions  # noqa: E402
from ortholoc_edge.pipeline.outcome import Fix, Rejected  # noqa: E402

# Small, and of another shape than square: a network that takes rows for columns shows.
SIZES = {
    "dedode": ((224, 168), None),
    "loftr": ((192, 128), None),
    "minima-loftr": ((192, 128), None),
    "eloftr": ((192, 128), None),
    "xoftr": ((192, 128), None),
    "dkm": ((160, 128), (224, 160)),
    "gim-dkm": ((160, 128), (224, 160)),
    "roma": ((140, 112), (224, 160)),
    "minima-roma": ((140, 112), (224, 160)),
    "dust3r": ((160, 128), None),
    "mast3r": ((160, 128), None),
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("wheel") / "vismatch.whl"
    try:
        path.write_bytes(models.fetched_wheel(vismatch("loftr")))
    except ModelError as err:
        if "pip" not in str(err) or os.environ.get("ORTHOLOC_EDGE_EXPORT_REQUIRED"):
            raise
        pytest.skip(f"the networks' code can't be fetched here: {err}")
    return path


@pytest.fixture(scope="module", autouse=True)
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(models.STORE_VARIABLE, str(tmp_path_factory.mktemp("store")))
        torch.set_num_threads(1)
        yield


@pytest.mark.filterwarnings("ignore")  # the networks' code is not ours to quieten
@pytest.mark.parametrize("name", EXPORTED)
def test_export_run_and_localize(name: str, wheel: Path) -> None:
    entry = EXPORTED[name]
    size, fine_size = SIZES.get(name, (None, None))
    order = Order(
        random_weights=True,
        small=True,
        accept_non_commercial=entry.non_commercial,
        size=size,
        fine_size=fine_size,
        wheel=wheel,
    )
    # It raises where the graph differs from the published code.
    record = build(name, order)
    assert set(record["differences"]) == {part or name for part in entry.graphs}
    assert record["random_weights"] is True
    assert exported.read_record(name) is None

    matcher = make_matcher(
        f"{name}{exported.RANDOM_SUFFIX}", working_px=160, max_keypoints=200, threads=1, random_weights=True
    )
    if size is not None:
        assert matcher.working_px == max(size)
    picture = rendered.picture(rendered.pose())[..., 1]
    query = matcher.extract(picture)
    assert isinstance(query, pairs.Picture) == (entry.family in ("pairs", "warp", "points"))
    valid = np.ones(picture.shape, np.bool_)
    valid[:, :200] = False
    found = matcher.match(query, matcher.extract(picture, valid))
    again = matcher.match(query, matcher.extract(picture, valid))
    np.testing.assert_array_equal(found.query_px, again.query_px)
    assert (found.map_px[:, 0] > 200).all()
    assert len(found) <= 200
    assert np.isfinite(found.query_px).all()
    black = cv2.merge([np.zeros(picture.shape, np.uint8)])
    assert len(matcher.match(query, matcher.extract(black))) == 0

    localizer = Localizer(rendered.CAMERA, rendered.store(), matcher, LocalizerOptions())
    try:
        outcome = localizer.localize(rendered.frame(rendered.pose()), rendered.prior(rendered.pose()))
    finally:
        localizer.close()
    assert isinstance(outcome, Rejected | Fix)
