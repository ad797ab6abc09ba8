"""Commands of the page over real sockets: what steers the search, and who may not."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import msgspec
import pytest
from replay import rendered

from ortholoc_edge.adapters.messages import CommandReply, SearchFor
from ortholoc_edge.adapters.page import ground_page
from ortholoc_edge.adapters.page.ground_page import GroundPage
from ortholoc_edge.adapters.page.http import Guard
from ortholoc_edge.adapters.page.options import PageOptions, refused
from ortholoc_edge.clock import SystemClock

from .test_page_server import TOKEN, ask, get, listening, status, wait_for

OURS = "127.0.0.1:8080"
SQUARE = {"corners": [[-10.0, -10.0], [10.0, -10.0], [10.0, 10.0]]}


class Page:
    """A page whose frame path says what the test wants."""

    def __init__(self, answers: Callable[[], Any] | None) -> None:
        self.commands: list[SearchFor] = []
        self.left: list[Future[Any]] = []

        def leave(command: Any) -> Any:
            self.commands.append(command)
            assert answers is not None
            self.left.append(answers())
            return self.left[-1]

        self.page = GroundPage(
            listening(TOKEN), SystemClock(), rendered.store(), rendered.CAMERA, None,
            {"matcher": "m", "vehicle": "hawk"}, None if answers is None else leave,
        )  # fmt: skip
        wait_for(lambda: self.page.address, "an address")
        self.port = int(str(self.page.address).rpartition(":")[2])

    def post(self, body: bytes, **changes: str | None) -> tuple[int, bytes]:
        cookie = f"ortholoc_page={Guard(TOKEN)._cookie}"
        headers: dict[str, str | None] = {
            "Origin": f"http://{OURS}", "Content-Type": "application/json", "Content-Length": str(len(body)),
            "Cookie": cookie,
        }  # fmt: skip
        headers.update({name.replace("_", "-"): value for name, value in changes.items()})
        lines = [f"{name}: {value}" for name, value in headers.items() if value is not None]
        answer = ask(self, get("/command/search", OURS, *lines, method="POST") + body)  # type: ignore[arg-type]
        return status(answer), answer.partition(b"\r\n\r\n")[2]


def done(reply: Any) -> Callable[[], Future[Any]]:
    def make() -> Future[Any]:
        future: Future[Any] = Future()
        _ = future.set_exception(reply) if isinstance(reply, Exception) else future.set_result(reply)
        return future

    return make


ACCEPTED = CommandReply(command="search", accepted=True)


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Any], Page]]:
    monkeypatch.setattr(ground_page, "_COMMAND_PAUSE_S", 0.0)
    pages: list[Page] = []

    def one(answers: Any) -> Page:
        pages.append(Page(answers))
        return pages[-1]

    yield one
    for page in pages:
        page.page.close()


def test_a_polygon_gets_to_the_frame_path_as_places_on_the_earth(make: Callable[[Any], Page]) -> None:
    page = make(done(ACCEPTED))
    code, body = page.post(json.dumps(SQUARE).encode())
    assert (code, msgspec.json.decode(body, type=CommandReply)) == (200, ACCEPTED)
    assert page.post(b"{}")[0] == 200
    here, everywhere = page.commands
    assert everywhere.polygon is None
    assert here.polygon is not None
    west, south, east, north = rendered.store().bounds
    origin = round((west + east) / 2), round((south + north) / 2)
    found = rendered.georeference().map_from_lat_lon(here.polygon) - origin
    assert abs(found - SQUARE["corners"]).max() < 0.01


@pytest.mark.parametrize(
    ("reply", "words"),
    [
        (CommandReply(command="search", accepted=False, reason="outside", remedy="inside"), "outside"),
        (ZeroDivisionError("x"), "it failed"),
    ],
)
def test_a_refusal_says_why(make: Callable[[Any], Page], reply: Any, words: str) -> None:
    code, body = make(done(reply)).post(b"{}")
    told = msgspec.json.decode(body, type=CommandReply)
    assert (code, told.accepted) == (200, False) and words in told.reason and told.remedy


def test_others_are_served_while_the_frame_path_is_busy(
    make: Callable[[Any], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ground_page, "_COMMAND_WAIT_S", 1.0)
    page = make(Future)
    answers: list[tuple[int, bytes]] = []
    asker = threading.Thread(target=lambda: answers.append(page.post(b"{}")))
    asker.start()
    wait_for(lambda: page.left, "a command")
    assert status(ask(page, get("/page.css"))) == 200  # type: ignore[arg-type]
    assert not answers
    asker.join(timeout=10.0)
    assert b"did not come to it" in answers[0][1]
    assert page.left[0].cancelled(), "and is not carried out later"


@pytest.mark.parametrize(
    ("body", "changes", "expected"),
    [
        (b"{}", {"Cookie": None}, 401),
        (b"{}", {"Cookie": "ortholoc_page=wrong"}, 401),
        (b"{}", {"Origin": None}, 403),
        (b"{}", {"Origin": "http://evil.example"}, 403),
        (b"{}", {"Origin": "null"}, 403),
        (b"{}", {"Sec_Fetch_Site": "cross-site"}, 403),
        (b"{}", {"Content_Type": "text/plain"}, 415),
        (b"corners=1", {"Content_Type": "application/x-www-form-urlencoded"}, 415),
        (b"", {"Content_Length": None}, 400),
        (b"{}", {"Content_Length": "-1"}, 400),
        (b"{}", {"Transfer_Encoding": "chunked"}, 400),
        (b"", {"Content_Length": "8193"}, 413),
    ],
)
def test_who_may_not_command(
    make: Callable[[Any], Page], body: bytes, changes: dict[str, str | None], expected: int
) -> None:
    page = make(done(ACCEPTED))
    assert page.post(body, **changes)[0] == expected
    assert page.commands == []


@pytest.mark.parametrize(
    "body",
    [
        b"", b"[]", bytes(range(256)), b"[" * 8000, b'{"speed": 1}', b'{"corners": [[0, 0], [1, 1]]}',
        b'{"corners": [[NaN, 0], [1, 1], [2, 0]]}', b'{"corners": [[1e300, 0], [1, 1], [2, 0]]}',
        b'{"corners": [[1, 2, 3], [1, 1, 1], [2, 0, 1]]}',
    ],
)  # fmt: skip
def test_garbage_is_refused(make: Callable[[Any], Page], body: bytes) -> None:
    page = make(done(ACCEPTED))
    code, told = page.post(body)
    assert code == 200 and not msgspec.json.decode(told, type=CommandReply).accepted
    assert page.commands == []


def test_it_is_off_by_default_and_not_too_often(make: Callable[[Any], Page], monkeypatch: pytest.MonkeyPatch) -> None:
    assert make(None).post(b"{}")[0] == 405
    monkeypatch.setattr(ground_page, "_COMMAND_PAUSE_S", 60.0)
    page = make(done(ACCEPTED))
    assert [page.post(b"{}")[0] for _ in range(3)] == [200, 503, 503]
    assert len(page.commands) == 1


def test_commands_need_a_token(tmp_path: Path) -> None:
    assert not PageOptions().commands
    assert "without token_file" in str(refused(PageOptions(commands=True)))
    assert refused(PageOptions(commands=True, token_file=str(tmp_path / "t"))) is None


def test_a_command_in_pieces_is_one(make: Callable[[Any], Page]) -> None:
    page = make(done(ACCEPTED))
    large = json.dumps({"corners": [[i + 0.123456789, i * i + 0.5] for i in range(100)]}, indent=1).encode()
    assert page.post(large)[0] == 200
    assert len(page.commands) == 1 and len(page.commands[0].polygon or ()) == 100


