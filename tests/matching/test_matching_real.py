"""On recorded photos, where they lie beside the repository (they are not part of it)."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, ImageArray
from ortholoc_edge.matching import models
from ortholoc_edge.matching.adhop import fit_homography
from ortholoc_edge.matching.lighterglue import LighterGlueMatcher
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.matching.types import Matcher
from ortholoc_edge.matching.xfeat import XFeatMatcher
from ortholoc_edge.matching.xfeat_star import XFeatStarMatcher

SHARED = Path(os.environ.get("ORTHOLOC_EDGE_SHARED", Path(__file__).parents[2].parent / "shared"))


def _sample(path: str) -> tuple[ImageArray, ImageArray, BoolArray, FloatArray]:
    """Query and DOP turned to the query's heading, both grey; where the DOP is; and, per query pixel, the
    true pixel in that DOP (NaN where the ground is unknown)."""
    file = SHARED / "data" / "real" / path
    if not file.is_file():
        pytest.skip(f"recorded sample {file} is not here; set ORTHOLOC_EDGE_SHARED")
    with np.load(file, allow_pickle=False) as sample:
        query = cv2.cvtColor(sample["image_query"], cv2.COLOR_RGB2GRAY)
        dop = cv2.cvtColor(sample["image_dop"], cv2.COLOR_RGB2GRAY)
        surface = sample["dsm"].astype(np.float64)
        ground = sample["point_map"].astype(np.float64)
        right_of_camera = sample["extrinsics"][0, :3]
    v, u = np.nonzero(np.isfinite(surface[..., 0]))
    plane = np.column_stack([surface[v, u, :2], np.ones(len(v))])
    dop_from_ground = np.linalg.lstsq(plane, np.column_stack([u, v]))[0]
    heading = np.degrees(np.arctan2(right_of_camera[1], right_of_camera[0]))
    rows, columns = dop.shape
    turn = cv2.getRotationMatrix2D(((columns - 1) / 2, (rows - 1) / 2), -heading, 1.0)
    valid = cv2.warpAffine((dop > 0).astype(np.uint8), turn, (columns, rows), flags=cv2.INTER_NEAREST) > 0
    ones = np.ones((*query.shape, 1))
    true = np.concatenate([ground[..., :2], ones], axis=-1) @ dop_from_ground
    true = np.concatenate([true, ones], axis=-1) @ turn.T
    return query, cv2.warpAffine(dop, turn, (columns, rows)), valid, true


# Right within 5 px of the DOP, of all matches; about three quarters of what was seen. Seneca is fields in
# false colour: few repeatable corners.
CASES = [
    ("xfeat", "caliterra/samples/CALITERRA_R0001.npz", 270),
    ("xfeat", "copr/samples/COPR_R0000.npz", 320),
    ("xfeat", "seneca/samples/SENECA_R0000.npz", 30),
    ("xfeat-star", "caliterra/samples/CALITERRA_R0001.npz", 280),
    ("xfeat-star", "copr/samples/COPR_R0000.npz", 470),
    ("xfeat-lighterglue", "caliterra/samples/CALITERRA_R0001.npz", 150),
    ("xfeat-lighterglue", "copr/samples/COPR_R0000.npz", 165),
    ("sift", "caliterra/samples/CALITERRA_R0001.npz", 700),
    ("sift", "seneca/samples/SENECA_R0000.npz", 60),
]


@pytest.mark.parametrize(("name", "path", "enough"), CASES)
def test_photo_matches_its_orthophoto(request: pytest.FixtureRequest, name: str, path: str, enough: int) -> None:
    query, dop, valid, true = _sample(path)
    matcher: Matcher = SiftMatcher()
    if name == "xfeat":
        model: models.StoredModel = request.getfixturevalue("xfeat_model")
        matcher = XFeatMatcher(model.graph, model.sha256)
    elif name != "sift":
        built: dict[str, models.StoredModel] = request.getfixturevalue("all_models")
        graphs = {one: (stored.graph, stored.sha256) for one, stored in built.items()}
        matcher = (
            XFeatStarMatcher(graphs["xfeat-star"], graphs["xfeat-star-fine"])
            if name == "xfeat-star"
            else LighterGlueMatcher(graphs["xfeat"], graphs["xfeat-lighterglue"])
        )
    matches = matcher.match(matcher.extract(query), matcher.extract(dop, valid))
    u, v = np.clip(np.rint(matches.query_px).astype(int).T, 0, [[query.shape[1] - 1], [query.shape[0] - 1]])
    errors = matches.map_px - true[v, u]
    right = np.linalg.norm(errors, axis=1) < 5
    assert right.sum() >= enough
    fitted = fit_homography(matches.map_px, matches.query_px, 12.0)
    assert fitted is not None
    assert fitted[1][right].mean() > 0.7


def test_orthophoto_against_itself_turned_a_little(xfeat_model: models.StoredModel) -> None:
    _, dop, valid, _ = _sample("seneca/samples/SENECA_R0000.npz")
    crop, whole = dop[200:840, 200:840], valid[200:840, 200:840]
    turn = cv2.getRotationMatrix2D((319.5, 319.5), 8.0, 1.0) + np.array([[0, 0, 12.0], [0, 0, -7.0]])
    seen = cv2.warpAffine(crop, turn, (640, 640))
    seen_valid = cv2.warpAffine(whole.astype(np.uint8), turn, (640, 640), flags=cv2.INTER_NEAREST) > 0
    matcher = XFeatMatcher(xfeat_model.graph, xfeat_model.sha256)
    matches = matcher.match(matcher.extract(crop, whole), matcher.extract(seen, seen_valid))
    errors = matches.map_px - (matches.query_px @ turn[:, :2].T + turn[:, 2])
    good = errors[np.linalg.norm(errors, axis=1) < 5]
    assert len(good) > 300
    assert np.median(np.linalg.norm(good, axis=1)) < 0.75
    assert np.abs(np.median(good, axis=0)).max() < 0.3
