"""What computes the networks: the choice, and refusals of what is not there or does not come to the same."""

from __future__ import annotations

import onnxruntime as ort
import pytest
from msgspec import ValidationError, convert

from ortholoc_edge.config import MatcherOptions
from ortholoc_edge.daemon import configured_matcher
from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.matching import models, providers
from ortholoc_edge.matching.registry import METHODS, make_matcher, make_method, runs_network
from ortholoc_edge.matching.xfeat import XFeatNetwork

NUMBERS = {"working_px": 320, "max_keypoints": 200, "threads": 1}
HERE = ort.get_available_providers()
ABSENT = next(name for name, provider in providers._PROVIDERS.items() if provider.names[0] not in HERE)


def test_an_absent_provider_is_named_with_what_there_is_and_the_remedy() -> None:
    for name in ("xfeat", "structural+disk-lightglue"):
        with pytest.raises(ConfigError, match=rf"provider '{ABSENT}' is not in .*which has cpu.*install .*or choose"):
            make_method(name, **NUMBERS, provider=ABSENT)
    with pytest.raises(ConfigError, match=r"provider 'gpu' is not known; known are: cpu, xnnpack, cuda"):
        make_matcher("xfeat", **NUMBERS, provider="gpu")


@pytest.mark.parametrize("name", ["structural", "sift", "structural+sift", "orb"])
def test_without_a_network_there_is_nothing_to_compute(name: str) -> None:
    assert not runs_network(name)
    with pytest.raises(ConfigError, match="runs no network that provider 'openvino' could compute"):
        make_method(name, **NUMBERS, provider="openvino")


def test_which_methods_run_a_network() -> None:
    without = [name for name in METHODS if not runs_network(name)]
    assert without == [
        "structural", "structural+sift", "structural+orb", "structural+akaze", "sift", "orb", "akaze",
    ]  # fmt: skip


def test_the_choice_reaches_every_session_and_no_further(
    xfeat_model: models.StoredModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[list[tuple[str, dict[str, str]]], int]] = []
    real = ort.InferenceSession

    def session(graph: bytes, options: ort.SessionOptions, providers: list[tuple[str, dict[str, str]]]) -> object:
        asked.append((providers, options.intra_op_num_threads))
        made = real(graph, options, providers=["CPUExecutionProvider"])
        # What it would say if the runtime had taken the choice.
        monkeypatch.setattr(made, "get_providers", lambda: [name for name, _ in providers])
        return made

    monkeypatch.setattr(ort, "InferenceSession", session)
    monkeypatch.setattr(ort, "get_available_providers", lambda: ["XnnpackExecutionProvider", "CPUExecutionProvider"])
    monkeypatch.setenv(models.STORE_VARIABLE, str(xfeat_model.path.parents[1]))
    options = MatcherOptions(name="structural+xfeat", threads=3, provider="xnnpack")
    configured_matcher(options)
    # Of the comparison with the published model, and of the matcher. Xnnpack has threads of its own.
    xnnpack = "XnnpackExecutionProvider"
    assert asked == [
        ([(xnnpack, {"intra_op_num_threads": "1"}), ("CPUExecutionProvider", {})], 1),
        ([(xnnpack, {"intra_op_num_threads": "3"}), ("CPUExecutionProvider", {})], 1),
    ]
    assert providers.chosen() == "cpu"
    asked.clear()
    make_method("xfeat", **NUMBERS | {"threads": 2})
    assert [one for one, _ in asked] == [[("CPUExecutionProvider", {})]] * 2
    assert [threads for _, threads in asked] == [1, 2]


def test_a_silent_fall_back_to_the_processor_is_refused(
    xfeat_model: models.StoredModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As onnxruntime does where the GPU's libraries can't be loaded."""
    monkeypatch.setattr(ort, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"])
    real = ort.InferenceSession
    monkeypatch.setattr(
        ort, "InferenceSession", lambda graph, options, providers: real(graph, options, ["CPUExecutionProvider"])
    )
    with (
        providers.computed_by("cuda"),
        pytest.raises(ModelError, match="XFeat graph: onnxruntime has CUDAExecutionProvider, but could not start it"),
    ):
        XFeatNetwork(xfeat_model.graph, xfeat_model.sha256, 1)


def test_the_configuration_knows_the_names() -> None:
    assert convert({"provider": "tensorrt"}, MatcherOptions).provider == "tensorrt"
    assert MatcherOptions().provider == "cpu"
    with pytest.raises(ValidationError, match=r"\$\.provider"):
        convert({"provider": "gpu"}, MatcherOptions)
