"""What `models build` asks for before it loads PyTorch: licences, files, hashes; fetching, from this machine."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from ortholoc_edge.cli import main
from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.export.order import Order, check_order, checked, fetch
from ortholoc_edge.matching import models
from ortholoc_edge.matching.exported import EXPORTED, WeightsFile

WEIGHTS = b"weights" * 1000
SHA256 = hashlib.sha256(WEIGHTS).hexdigest()
FILE = WeightsFile("net", "net.pth", "someone/net", "https://nowhere.invalid/net.pth", SHA256)


@pytest.mark.parametrize("name", [entry.name for entry in EXPORTED.values() if entry.non_commercial])
@pytest.mark.parametrize("order", [Order(), Order(fetch=True), Order(random_weights=True)])
def test_a_non_commercial_licence_takes_an_explicit_yes(name: str, order: Order) -> None:
    with pytest.raises(ModelError, match=r"forbids commercial use.*--accept-non-commercial"):
        check_order(EXPORTED[name], order)
    check_order(
        EXPORTED[name], dataclasses.replace(order, accept_non_commercial=True, random_weights=True, fetch=False)
    )


def test_missing_files_are_named_with_what_can_be_done() -> None:
    with pytest.raises(ModelError, match=r"--weights dinov2=dinov2_vitl14_pretrain\.pth.*--fetch \(https://dl\."):
        check_order(EXPORTED["roma"], Order(weights={"roma": Path("x")}))
    # Nothing to compare a fetched file with.
    with pytest.raises(ModelError, match=r"--weights DKMv3_outdoor\.pth$"):
        check_order(EXPORTED["dkm"], Order())
    check_order(EXPORTED["dkm"], Order(weights={"dkm": Path("x")}))


@pytest.mark.parametrize(
    ("order", "said"),
    [
        (Order(weights={"lfotr": Path("x")}), "no weights 'lfotr'; its parts are loftr"),
        (Order(sha256={"x": "0"}), "no weights 'x'"),
        (Order(weights={"loftr": Path("x")}, random_weights=True), "not both"),
        (Order(fetch=True, random_weights=True), "not both"),
        (Order(weights={"loftr": Path("x")}, small=True), "whole network"),
    ],
)
def test_orders_that_contradict_themselves(order: Order, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_order(EXPORTED["loftr"], order)


def test_hashes(tmp_path: Path) -> None:
    path = tmp_path / "mine.pth"
    path.write_bytes(WEIGHTS)
    unknown = dataclasses.replace(FILE, sha256=None)
    assert checked(path, FILE, None) == (SHA256, True)
    assert checked(path, unknown, SHA256.upper()) == (SHA256, True)
    assert checked(path, unknown, None) == (SHA256, False)
    path.write_bytes(WEIGHTS[1:])
    with pytest.raises(
        ModelError, match=f"SHA-256 is .*of net.pth of someone/net {SHA256}; get net.pth from someone/net"
    ):
        checked(path, FILE, hashlib.sha256(WEIGHTS[1:]).hexdigest())
    with pytest.raises(ModelError, match="that was given"):
        checked(path, unknown, SHA256)
    with pytest.raises(ModelError, match="can't be read"):
        checked(tmp_path / "none", FILE, None)


@pytest.fixture
def server() -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/net.pth" else 404)
            self.end_headers()
            self.wfile.write(WEIGHTS)

        def log_message(self, *_: object) -> None:
            pass

    serving = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=serving.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{serving.server_port}"
    serving.shutdown()
    thread.join()
    serving.server_close()


def test_fetch(server: str, tmp_path: Path) -> None:
    near = dataclasses.replace(FILE, address=f"{server}/net.pth")
    path = fetch(near, tmp_path / "weights")
    assert path.read_bytes() == WEIGHTS
    # What is there is not fetched again: this address answers nothing.
    assert fetch(dataclasses.replace(near, address=f"{server}/gone"), tmp_path / "weights") == path
    path.write_bytes(b"damaged")
    assert fetch(near, tmp_path / "weights").read_bytes() == WEIGHTS


def test_a_fetched_file_that_differs_is_not_kept(server: str, tmp_path: Path) -> None:
    other = dataclasses.replace(FILE, address=f"{server}/net.pth", sha256="0" * 64)
    with pytest.raises(ModelError, match=f"SHA-256 is {SHA256}"):
        fetch(other, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"address": None}, "no lasting address"),
        ({"sha256": None}, "no lasting SHA-256"),
        ({"address": "gone"}, "network"),
    ],
)
def test_what_cant_be_fetched(server: str, tmp_path: Path, change: dict[str, str | None], said: str) -> None:
    if change.get("address") == "gone":
        change = {"address": f"{server}/gone"}
    with pytest.raises(ModelError, match=rf"{said}.*--weights"):
        fetch(dataclasses.replace(FILE, **change), tmp_path)


def test_several_files_are_told_apart_by_their_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    assert main(["models", "build", "roma", "--weights", "roma_outdoor.pth"]) != 0
    assert "takes roma and dinov2; write --weights roma=roma_outdoor.pth" in capsys.readouterr().err
    assert main(["models", "build", "roma", "--weights", "roma=a", "--weights", "roma=b"]) != 0
    assert "given twice" in capsys.readouterr().err
    assert main(["models", "build", "dust3r", "--weights", "x.pth"]) != 0
    assert "forbids commercial use" in capsys.readouterr().err
