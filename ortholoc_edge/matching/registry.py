"""Matchers by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.matching import models, providers
from ortholoc_edge.matching.binary import BinaryMatcher
from ortholoc_edge.matching.exported import EXPORTED, RANDOM_SUFFIX, load
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.matching.types import STRUCTURAL, AnyMatcher, Matcher, Structural

# Without weights; which of them OpenCV lacks, `binary.unavailable` says.
BINARY: Final = ("orb", "akaze")
MATCHERS: Final = (
    "xfeat", "xfeat-star", "xfeat-lighterglue", "aliked-lightglue", "disk-lightglue", "sift", *BINARY, *EXPORTED,
)  # fmt: skip
# Graphs of random weights, to test a path with; in none of the lists, so that nobody flies with one.
RANDOM: Final = tuple(f"{name}{RANDOM_SUFFIX}" for name in EXPORTED)
# Ways to match a frame with the map: those, structural matching, and structural matching with one of those for frames
# that it can't place.
METHODS: Final = (STRUCTURAL, *(f"{STRUCTURAL}+{name}" for name in MATCHERS), *MATCHERS)

# Matchers that run several graphs.
_PAIRED: Final = ("xfeat-star", "xfeat-lighterglue", "aliked-lightglue", "disk-lightglue")


def make_method(
    name: str,
    *,
    working_px: int,
    max_keypoints: int,
    threads: int,
    model_path: Path | None = None,
    model_sha256: str | None = None,
    provider: str = providers.CPU,
    progress: models.Progress | None = None,
    random_weights: bool = False,
) -> AnyMatcher:
    """One of ``METHODS``; arguments and errors are those of `make_matcher`, for its matcher of features."""
    if name not in METHODS and not (name in RANDOM and random_weights):
        raise ConfigError(f"matcher {name!r} is not known; known are: {', '.join(METHODS)}")
    if name == STRUCTURAL:
        _without_network(name, provider)
        if model_path is not None or model_sha256 is not None:
            raise ConfigError(f"matcher {name!r} uses no model; leave it away")
        return Structural()
    structural = name.startswith(f"{STRUCTURAL}+")
    matcher = make_matcher(
        name.removeprefix(f"{STRUCTURAL}+"),
        working_px=working_px,
        max_keypoints=max_keypoints,
        threads=threads,
        model_path=model_path,
        model_sha256=model_sha256,
        provider=provider,
        progress=progress,
        random_weights=random_weights,
    )
    return Structural(matcher) if structural else matcher


def make_matcher(
    name: str,
    *,
    working_px: int,
    max_keypoints: int,
    threads: int,
    model_path: Path | None = None,
    model_sha256: str | None = None,
    provider: str = providers.CPU,
    progress: models.Progress | None = None,
    random_weights: bool = False,
) -> Matcher:
    """The matcher of this name, its model loaded (and built first where the store lacks it).

    Args:
        name: one of ``MATCHERS``.
        working_px: long side that images are brought to; a matcher whose graph has a fixed size keeps to that.
        max_keypoints: per image, or matches at most of those that look at two pictures at once; LighterGlue takes no
            more than `lighterglue.MOST_KEYPOINTS`.
        threads: of one inference; SIFT, ORB and AKAZE take OpenCV's setting (``cv2.setNumThreads``).
        model_path: a model file instead of the store's; not for matchers that run several.
        model_sha256: hash that the file must have; None: the record beside the file says it.
        provider: one of `providers.NAMES`, which computes the networks.
        progress: told of a build's steps.
        random_weights: whether one of ``RANDOM`` may be named: what tests a path, and must not fly.
    Raises: ConfigError for an unknown name, a number out of range, a provider that is not installed, or a model or a
        provider where no network is run; ModelError if the model can't be had.
    """
    if name in RANDOM and not random_weights:
        raise ConfigError(
            f"matcher {name!r} has random weights, to test a path with, and finds nothing; name "
            f"{name.removesuffix(RANDOM_SUFFIX)}"
        )
    if name not in MATCHERS + RANDOM:
        raise ConfigError(f"matcher {name!r} is not known; known are: {', '.join(MATCHERS)}")
    if model_path is None and model_sha256 is not None:
        raise ConfigError("a model's SHA-256 was given without the model's file; give both or none")
    try:
        if not runs_network(name):
            _without_network(name, provider)
            if model_path is not None:
                raise ConfigError(f"matcher {name!r} uses no model; leave {model_path} away")
            if name == "sift":
                return SiftMatcher(working_px=working_px, max_keypoints=max_keypoints)
            return BinaryMatcher(name, working_px=working_px, max_keypoints=max_keypoints)
        if (name in EXPORTED or name in RANDOM) and model_path is not None:
            raise ConfigError(f"matcher {name!r} is taken from the store only; leave {model_path} away")
        if name in _PAIRED and model_path is not None:
            raise ConfigError(
                f"matcher {name!r} runs several models, {model_path} can't stand for all; leave it away and have "
                f"them in ${models.STORE_VARIABLE}/models"
            )
        with providers.computed_by(provider):
            if name in EXPORTED or name in RANDOM:
                return _exported(name, working_px, max_keypoints, threads)
            if name in _PAIRED:
                return _paired(name, working_px, max_keypoints, threads, progress)
            # Not at the top: SIFT must work where the inference runtime does not.
            from ortholoc_edge.matching.xfeat import XFeatMatcher

            model = (
                models.ensure(name, progress)
                if model_path is None
                else models.load_file(model_path, model_sha256)
            )
            return XFeatMatcher(
                model.graph, model.sha256, working_px=working_px, max_keypoints=max_keypoints, threads=threads
            )
    except ValueError as err:
        raise ConfigError(f"matcher {name}: {err}") from err


def runs_network(method: str) -> bool:
    """Whether one of ``METHODS`` has a network to compute."""
    return method.removeprefix(f"{STRUCTURAL}+") not in (STRUCTURAL, "sift", *BINARY)


def takes_working_px(method: str) -> bool:
    """Whether one of ``METHODS`` has a matcher whose resolution can be chosen: some networks have one of their own."""
    name = method.removeprefix(f"{STRUCTURAL}+")
    return name != STRUCTURAL and (name not in EXPORTED or EXPORTED[name].family == "superpoint")


def _without_network(name: str, provider: str) -> None:
    if provider != providers.CPU:
        raise ConfigError(
            f"matcher {name!r} runs no network that provider {provider!r} could compute; leave the provider away"
        )


def _paired(
    name: str, working_px: int, max_keypoints: int, threads: int, progress: models.Progress | None
) -> Matcher:
    # Late for the same reason.
    from ortholoc_edge.matching.aliked import AlikedExtractor
    from ortholoc_edge.matching.disk import DiskExtractor
    from ortholoc_edge.matching.lighterglue import LighterGlueMatcher, LightGlueMatcher
    from ortholoc_edge.matching.xfeat_star import XFeatStarMatcher

    stored = [models.ensure(one, progress) for one in (name, *models.known(name).needs)]
    own, *needed = ((one.graph, one.sha256) for one in stored)
    if name == "xfeat-star":
        return XFeatStarMatcher(
            own, *needed, working_px=working_px, max_keypoints=max_keypoints, threads=threads
        )
    kinds: dict[str, Callable[..., Matcher]] = {
        "xfeat-lighterglue": LighterGlueMatcher,
        "aliked-lightglue": partial(LightGlueMatcher, name, AlikedExtractor),
        "disk-lightglue": partial(LightGlueMatcher, name, DiskExtractor),
    }
    return kinds[name](*needed, own, working_px=working_px, max_keypoints=max_keypoints, threads=threads)


def _exported(name: str, working_px: int, max_keypoints: int, threads: int) -> Matcher:
    # Late for the same reason.
    from ortholoc_edge.matching import pairs
    from ortholoc_edge.matching.dedode import DedodeMatcher
    from ortholoc_edge.matching.superpoint import make_superpoint_matcher

    entry = EXPORTED[name.removesuffix(RANDOM_SUFFIX)]
    graphs = load(entry.name, random_weights=name in RANDOM)
    least = entry.min_confidence
    match entry.family:
        case "superpoint":
            return make_superpoint_matcher(name, entry, graphs, working_px, max_keypoints, threads)
        case "dedode":
            return DedodeMatcher(name, graphs, min_confidence=least, max_keypoints=max_keypoints, threads=threads)
        case "pairs":
            return pairs.PointPairMatcher(
                name, graphs[0], min_confidence=least, max_matches=max_keypoints, threads=threads
            )
        case "warp":
            return pairs.WarpMatcher(
                name, graphs[0], min_confidence=least, max_matches=max_keypoints, threads=threads
            )
        case "points":
            return pairs.PointMapMatcher(
                name, graphs[0], min_confidence=least, euclidean=entry.name == "dust3r",
                max_matches=max_keypoints, threads=threads,
            )  # fmt: skip
