"""Options that every command with a matcher shares."""

from __future__ import annotations

import argparse
from pathlib import Path

from ortholoc_edge.cli.arguments import positive_int
from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.config import MatcherOptions
from ortholoc_edge.matching import providers
from ortholoc_edge.matching.registry import METHODS, RANDOM, make_method
from ortholoc_edge.matching.types import STRUCTURAL, AnyMatcher


def add(parser: argparse.ArgumentParser, default: str = STRUCTURAL) -> None:
    group = parser.add_argument_group("matching")
    group.add_argument(
        "--matcher",
        choices=(*METHODS, *RANDOM),
        default=default,
        metavar="NAME",
        help=f"{', '.join(METHODS)}. Structural matching needs no model and a predicted pose; with +NAME that matcher "
        "takes the frames that it can't place (default: %(default)s)",
    )
    group.add_argument(
        "--working-px",
        type=positive_int,
        default=640,
        help="long side at which a matcher of features sees images, px; a multiple of 32 for all but sift (default: "
        "%(default)s)",
    )
    group.add_argument(
        "--max-keypoints",
        type=positive_int,
        default=4096,
        help="per image; fewer are faster; xfeat-lighterglue takes 1024 at most (default: %(default)s)",
    )
    group.add_argument(
        "--threads", type=positive_int, default=1, help="threads of one inference (default: %(default)s)"
    )
    add_provider(group)
    group.add_argument("--model", type=Path, metavar="FILE", help="an ONNX file instead of the built model; for xfeat")
    group.add_argument("--model-sha256", metavar="HASH", help="refuse --model unless it has this SHA-256")
    group.add_argument("--no-adhop", action="store_true", help="one matching round only")


def add_provider(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--provider",
        choices=providers.NAMES,
        default=providers.CPU,
        help="what computes a matcher's networks, of what the installed onnxruntime has (default: %(default)s)",
    )


def add_features(parser: argparse.ArgumentParser) -> None:
    """For commands that work on a pack as it is."""
    parser.add_argument(
        "--features",
        choices=("auto", "never", "require"),
        default="auto",
        help="match with the pack's precomputed features: where it has some of this model, never, or only with them"
        " (default: %(default)s)",
    )


def settings(args: argparse.Namespace) -> MatcherOptions:
    """The arguments as the daemon's ``[matcher]`` table."""
    return MatcherOptions(
        name=args.matcher,
        working_px=args.working_px,
        max_keypoints=args.max_keypoints,
        threads=args.threads,
        model=None if args.model is None else str(args.model),
        model_sha256=args.model_sha256,
        provider=args.provider,
    )


def matcher(args: argparse.Namespace) -> AnyMatcher:
    """The matcher that the arguments name; its model is built first where that was never done."""
    with ProgressBar(f"model {args.matcher}") as bar:
        return make_method(
            args.matcher,
            working_px=args.working_px,
            max_keypoints=args.max_keypoints,
            threads=args.threads,
            model_path=args.model,
            model_sha256=args.model_sha256,
            provider=args.provider,
            progress=bar.step,
            random_weights=args.matcher in RANDOM,
        )
