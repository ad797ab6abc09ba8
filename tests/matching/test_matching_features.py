"""All matchers: coordinates, masks, empty images, repeatability; on made scenes."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import field, view

from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.geometry.grid import resize_px
from ortholoc_edge.geometry.homography import warp_points
from ortholoc_edge.matching import binary, models
from ortholoc_edge.matching.binary import BinaryMatcher, unavailable
from ortholoc_edge.matching.lighterglue import LighterGlueMatcher
from ortholoc_edge.matching.registry import BINARY, make_matcher
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.matching.types import Features, Matcher, ReducibleMatcher
from ortholoc_edge.matching.xfeat import XFeatMatcher
from ortholoc_edge.matching.xfeat_star import XFeatStarMatcher

# They take any size, and see a picture shifted by whole pixels as the same.
HERE = tuple(name for name in BINARY if unavailable(name) is None)
UNROUNDED = ("sift", *HERE)


@pytest.fixture(params=["xfeat", "sift", "xfeat-star", "xfeat-lighterglue", *HERE])
def matcher(request: pytest.FixtureRequest) -> Matcher:
    if request.param == "sift":
        return SiftMatcher()
    if request.param in BINARY:
        return BinaryMatcher(request.param)
    if request.param == "xfeat":
        model: models.StoredModel = request.getfixturevalue("xfeat_model")
        return XFeatMatcher(model.graph, model.sha256)
    built: dict[str, models.StoredModel] = request.getfixturevalue("all_models")
    graphs = {name: (one.graph, one.sha256) for name, one in built.items()}
    if request.param == "xfeat-star":
        return XFeatStarMatcher(graphs["xfeat-star"], graphs["xfeat-star-fine"])
    return LighterGlueMatcher(graphs["xfeat"], graphs["xfeat-lighterglue"])


def _errors(matcher: Matcher, query, reference, homography) -> np.ndarray:
    """Displacements (N, 2) of matches from where the homography puts the query's pixels, gross ones left
    out."""
    matches = matcher.match(matcher.extract(query), matcher.extract(reference))
    if matcher.name == "xfeat-lighterglue":
        assert matches.confidence is not None
        assert matches.confidence.dtype == np.float64
        assert (matches.confidence > 0.1).all()
        assert (matches.confidence <= 1).all()
    else:
        assert matches.confidence is None
    errors = matches.map_px - warp_points(homography, matches.query_px)
    return errors[np.linalg.norm(errors, axis=1) < 5]


def _median_length(errors: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(errors, axis=1)))


def test_features_are_as_the_contract_says(matcher: Matcher) -> None:
    image = field(800, 600)
    features = matcher.extract(image)
    assert len(features) > 200
    assert features.keypoints_px.dtype == np.float64
    assert features.scores.dtype == features.descriptors.dtype == np.float32
    assert (np.diff(features.scores) <= 0).all()
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-4)
    assert (features.keypoints_px >= -0.5).all()
    assert (features.keypoints_px <= (799.5, 599.5)).all()


def test_same_input_gives_the_same_output(matcher: Matcher) -> None:
    image = field(640, 480)
    first, second = matcher.extract(image), matcher.extract(image.copy())
    np.testing.assert_array_equal(first.keypoints_px, second.keypoints_px)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    shifted = matcher.extract(np.roll(image, 9, axis=1))
    one, two = matcher.match(first, shifted), matcher.match(second, shifted)
    np.testing.assert_array_equal(one.query_px, two.query_px)
    np.testing.assert_array_equal(one.map_px, two.map_px)


@pytest.mark.parametrize(("u", "v"), [(5, 3), (16, 8), (-23, 41)])
def test_whole_pixel_shift_without_bias(matcher: Matcher, u: int, v: int) -> None:
    scene = field(760, 600)
    query, reference = scene[60:540, 60:700], scene[60 - v : 540 - v, 60 - u : 700 - u]
    errors = _errors(matcher, query, reference, np.array([[1, 0, u], [0, 1, v], [0, 0, 1.0]]))
    assert len(errors) > 150
    # XFeat works on 8 x 8 cells counted from the corner: shifted by part of a cell, it decides a little
    # otherwise. XFeat* does so at both of its levels, which no whole shift fits.
    # ORB's keypoints are whole pixels of smaller levels.
    in_step = matcher.name in ("sift", "akaze") or (u % 8 == 0 and v % 8 == 0 and matcher.name.startswith("xfeat"))
    in_step &= matcher.name != "xfeat-star"
    out_of_step = (1.2, 0.4) if matcher.name == "xfeat-star" else (0.9, 0.2)
    length, bias = (0.3, 0.1) if in_step else out_of_step
    assert _median_length(errors) < length
    assert np.abs(np.median(errors, axis=0)).max() < bias


@pytest.mark.parametrize(("width", "height"), [(1024, 768), (1000, 700), (700, 1000), (1280, 853)])
def test_pixels_of_the_original_come_back_exactly(matcher: Matcher, width: int, height: int) -> None:
    """Extracting from an image and from its working size is the same but for the half-pixel rule."""
    scene = field(width, height)
    scale = 640 / max(width, height)
    if matcher.name == "xfeat-star":
        pytest.skip("its levels are made of the original, so those of a smaller image are others")
    multiple = 1 if matcher.name in UNROUNDED else 32
    size = tuple(round(side * scale / multiple) * multiple for side in (width, height))
    whole = matcher.extract(scene)
    small = matcher.extract(cv2.resize(scene, size, interpolation=cv2.INTER_AREA))
    assert len(whole) > 200
    np.testing.assert_allclose(
        resize_px(whole.keypoints_px, (size[0] / width, size[1] / height)), small.keypoints_px, atol=1e-6
    )


def test_reduced_it_works_on_less_and_the_matcher_itself_as_before(matcher: Matcher) -> None:
    """A rung of the ladder: half the size, a quarter of the keypoints at most, in the original's pixels."""
    assert isinstance(matcher, ReducibleMatcher)
    scene = field(1024, 768)
    whole = matcher.extract(scene)
    half = matcher.reduced(0.5)
    assert (matcher.working_px, half.working_px) == (640, 320)
    few = half.extract(scene)
    assert 100 < len(few) <= len(whole) / 2
    assert np.ptp(few.keypoints_px, axis=0).min() > 500, "over the whole picture"
    np.testing.assert_array_equal(matcher.extract(scene).keypoints_px, whole.keypoints_px)
    shift = np.array([[1, 0, 32], [0, 1, -16], [0, 0, 1.0]])
    errors = _errors(half, scene[64:704, 64:960], scene[80:720, 32:928], shift)
    # Of its own pixels they are 2.8.
    assert len(errors) > 40 and np.abs(np.median(errors, axis=0)).max() < 1.0
    # It ends where nothing is left to see.
    assert half.reduced(0.1).working_px == 128


def test_change_of_resolution_without_bias(matcher: Matcher) -> None:
    """A 1024 px view and its middle 832 px, both brought to 640: the scales differ by 1.23."""
    scene = field(1024, 768)
    middle = scene[72:696, 96:928]
    errors = _errors(matcher, scene, middle, np.array([[1, 0, -96], [0, 1, -72], [0, 0, 1.0]]))
    assert len(errors) > 80
    assert np.abs(np.median(errors, axis=0)).max() < 0.3


def test_known_view_of_a_plane(matcher: Matcher) -> None:
    scene = field(1024, 768)
    homography = view(1024, 768)
    seen = cv2.warpPerspective(scene, homography, (1024, 768))
    errors = _errors(matcher, scene, seen, homography)
    assert len(errors) > 120
    assert _median_length(errors) < (1.3 if matcher.name in ("xfeat-star", "orb") else 1.0)
    assert np.abs(np.median(errors, axis=0)).max() < 0.15


def test_no_keypoint_near_what_is_invalid(matcher: Matcher) -> None:
    scene = field(800, 600)
    valid = np.ones(scene.shape, np.bool_)
    valid[:, 500:] = False
    valid[200:260, 100:180] = False
    holed = np.where(valid, scene, np.uint8(0))
    features = matcher.extract(holed, valid)
    assert len(features) > 100
    u, v = np.rint(features.keypoints_px).astype(int).T
    near = cv2.dilate((~valid).astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)
    assert not near[v, u].any()
    # What lies under the mask has no say at all.
    other = np.where(valid, scene, np.uint8(255))
    np.testing.assert_array_equal(matcher.extract(other, valid).keypoints_px, features.keypoints_px)
    # And the rest still matches the whole scene.
    matches = matcher.match(features, matcher.extract(scene))
    assert (np.linalg.norm(matches.query_px - matches.map_px, axis=1) < 2).sum() > 80


def test_an_all_valid_mask_is_no_mask(matcher: Matcher) -> None:
    scene = field(640, 480)
    masked = matcher.extract(scene, np.ones(scene.shape, np.bool_))
    np.testing.assert_array_equal(masked.keypoints_px, matcher.extract(scene).keypoints_px)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((0, 0), np.uint8),
        np.zeros((1, 1), np.uint8),
        np.full((9, 700), 3, np.uint8),
        np.full((480, 640), 255, np.uint8),
        np.full((33, 47), 100, np.uint8),
    ],
    ids=lambda image: str(image.shape),
)
def test_images_without_content_have_no_features(matcher: Matcher, image: np.ndarray) -> None:
    empty = matcher.extract(image)
    assert len(empty) == 0
    assert len(matcher.match(empty, empty)) == 0
    some = matcher.extract(field(320, 256))
    assert empty.descriptors.shape[1] == some.descriptors.shape[1]
    assert len(matcher.match(some, empty)) == len(matcher.match(empty, some)) == 0


def test_an_all_invalid_image_has_no_features(matcher: Matcher) -> None:
    scene = field(320, 256)
    assert len(matcher.extract(scene, np.zeros(scene.shape, np.bool_))) == 0
    few = np.zeros(scene.shape, np.bool_)
    few[100:110, 100:110] = True  # narrower than twice the margin
    assert len(matcher.extract(scene, few)) == 0


@pytest.mark.parametrize("shape", [(16, 16), (20, 700), (700, 20), (481, 641), (31, 33)])
def test_odd_sizes_are_no_error(matcher: Matcher, shape: tuple[int, int]) -> None:
    features = matcher.extract(field(shape[1], shape[0]))
    assert (features.keypoints_px <= (shape[1] - 0.5, shape[0] - 0.5)).all()


def test_other_types_are_refused(matcher: Matcher) -> None:
    scene = field(320, 256)
    for wrong in (scene.astype(np.float32), np.stack([scene] * 3, axis=-1)):
        with pytest.raises(ValueError, match="expected uint8"):
            matcher.extract(wrong)
    with pytest.raises(ValueError, match="valid mask"):
        matcher.extract(scene, np.ones((3, 3), np.bool_))


@pytest.mark.parametrize("matcher", UNROUNDED, indirect=True)
def test_those_without_weights_do_not_mind_a_turn(matcher: Matcher) -> None:
    scene = field(640, 480)
    turned = np.rot90(scene, 2)
    errors = _errors(matcher, scene, turned, np.array([[-1, 0, 639], [0, -1, 479], [0, 0, 1.0]]))
    assert len(errors) > 200
    # A quarter pixel off without OpenCV's precise upscaling; a half turn would show it twice.
    assert np.abs(np.median(errors, axis=0)).max() < 0.1


def test_a_failing_inference_is_a_model_error(xfeat_model: models.StoredModel) -> None:
    matcher = XFeatMatcher(xfeat_model.graph, xfeat_model.sha256)
    odd = field(100, 100)  # no multiple of 32: the pyramid's levels do not add up
    with pytest.raises(ModelError, match="inference failed on 100 x 100 px"):
        matcher._network.run(odd)


@pytest.mark.parametrize("values", [{"working_px": 100}, {"max_keypoints": 0}, {"threads": 0}])
def test_unusable_numbers_are_refused(xfeat_model: models.StoredModel, values: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="XFeat"):
        XFeatMatcher(xfeat_model.graph, xfeat_model.sha256, **values)


def test_the_best_are_kept(xfeat_model: models.StoredModel) -> None:
    scene = field(640, 480)
    many = XFeatMatcher(xfeat_model.graph, xfeat_model.sha256).extract(scene)
    few = XFeatMatcher(xfeat_model.graph, xfeat_model.sha256, max_keypoints=50).extract(scene)
    np.testing.assert_array_equal(few.keypoints_px, many.keypoints_px[:50])


def test_one_white_pixel_on_black_stays_finite(xfeat_model: models.StoredModel) -> None:
    """Its logit of 94 would overflow the softmax's exponentials."""
    scene = np.zeros((480, 640), np.uint8)
    scene[241, 322] = 255
    matcher = XFeatMatcher(xfeat_model.graph, xfeat_model.sha256)
    assert all(np.isfinite(output).all() for output in matcher._network.run(scene))
    assert np.isfinite(matcher.extract(scene).descriptors).all()


def test_binary_neighbours_are_those_by_hamming_distance() -> None:
    random = np.random.default_rng(0)
    one, other = (random.integers(0, 256, (60, 32), dtype=np.uint8) for _ in range(2))
    other[:20] = one[:20] ^ (np.uint8(1) << random.integers(0, 8, (20, 32), dtype=np.uint8))
    hamming = np.unpackbits(one[:, None] ^ other[None], axis=2).sum(axis=2)
    first, second = binary._signs(one), binary._signs(other)
    np.testing.assert_allclose(first @ second.T, 1 - 2 * hamming / 256, atol=1e-6)
    pixels = np.arange(120.0).reshape(60, 2)
    scores = np.ones(60, np.float32)
    found = BinaryMatcher("orb", ratio=0.5).match(Features(pixels, scores, first), Features(pixels, scores, second))
    # 32 of 256 bits are other than in the right one, and about half of them than in any wrong one.
    np.testing.assert_array_equal(found.query_px, pixels[:20])
    np.testing.assert_array_equal(found.map_px, pixels[:20])


def test_akaze_without_contrib_modules_is_named_with_what_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(binary, "_akaze_maker", lambda: None)
    with pytest.raises(ConfigError, match=r"akaze.*no AKAZE.*pip install opencv-contrib-python-headless"):
        make_matcher("akaze", working_px=640, max_keypoints=100, threads=1)


def test_a_model_for_a_binary_matcher_is_refused() -> None:
    with pytest.raises(ConfigError, match="'orb' uses no model"):
        make_matcher("orb", working_px=640, max_keypoints=100, threads=1, model_path=Path("x.onnx"))
