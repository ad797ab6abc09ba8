"""What the README and the example configuration promise must be what is there."""

import importlib.util
import re
import typing
from pathlib import Path

import msgspec

from ortholoc_edge import config
from ortholoc_edge.cli import _parser

ROOT = Path(__file__).resolve().parents[1]


def blocks(heading: str) -> list[str]:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text.split(f"## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"```sh\n(.*?)\n```", section, re.DOTALL)


def test_ci_runs_the_readmes_test_command():
    [command] = blocks("Test it")
    assert "\n" not in command
    assert f"\n{command}\n" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_readmes_main_command_is_one_line_that_runs_the_simulation():
    [command] = blocks("Fly it (no hardware, no data)")
    assert "\n" not in command
    assert command.endswith("ortholoc-edge sim")
    assert "-c constraints.txt" in command


def test_every_command_that_the_readme_names_exists():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    parser = _parser()
    [actions] = [a for a in parser._actions if hasattr(a, "choices") and a.choices]
    named = set(re.findall(r"`ortholoc-edge ([\w-]+)", text))
    assert named <= set(actions.choices)
    assert set(actions.choices) <= named | {"sim"}


DOCUMENTS = sorted(
    path
    for folder in (".", "docs", "docs/studies", "config", "systemd", "tiles")
    for path in (ROOT / folder).glob("*.md")
)


def code_of(document: Path) -> list[str]:
    """What is code: lines of blocks, those joined that go on, and spans of prose, which may go over a line's end."""
    text = document.read_text(encoding="utf-8")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return lines + [span.replace("\n", " ") for span in re.findall(r"`([^`]+)`", prose)]


def test_commands_and_options_that_the_documents_name_exist():
    top = _parser()
    found = 0
    for document in DOCUMENTS:
        for line in code_of(document):
            # Up to a comment, or where another program begins.
            for words in re.findall(r"\bortholoc-edge((?: [^#;&|>]*)?)", line):
                parser, rest = top, words.split()
                while rest and (choices := subcommands(parser)):
                    while rest[0].startswith("-"):
                        assert rest[0] in parser._option_string_actions, f"{document.name}: {line}"
                        rest.pop(0)
                    if not re.fullmatch(r"[a-z][\w-]*", rest[0]):
                        break
                    assert rest[0] in choices, f"{document.name}: there is no {rest[0]}: {line}"
                    parser = choices[rest.pop(0)]
                options = [word.split("=")[0].rstrip(",.:)") for word in rest if word.startswith("--")]
                found += len(options)
                for option in options:
                    assert option in parser._option_string_actions, f"{document.name}: there is no {option}: {line}"
    assert found > 50


def subcommands(parser) -> dict:
    return next((a.choices for a in parser._actions if hasattr(a, "choices") and isinstance(a.choices, dict)), {})


def test_scripts_and_modules_that_the_documents_name_exist():
    found = 0
    for document in DOCUMENTS:
        for line in code_of(document):
            for module in re.findall(r"python3? -m (ortholoc_\w+(?:\.\w+)*)", line):
                assert importlib.util.find_spec(module) is not None, f"{document.name}: there is no {module}"
                found += 1
            for script in re.findall(r"python3? ([\w/]+\.py)", line):
                assert (ROOT / script).is_file(), f"{document.name}: there is no {script}"
                found += 1
    assert found > 10


def test_configuration_keys_that_the_documents_name_exist():
    """``[table] key``, ``[table.part] key`` and ``table.key`` of tables that there are."""
    found = 0
    for document in DOCUMENTS:
        if document.name == "simulation.md":
            continue  # its tables are those of scenarios
        for line in code_of(document):
            # `link.fusion`, `camera.frames` and the like are statistics, and `page.js` is a file.
            named = re.fullmatch(r"\[([\w.]+)\] (\w+)(?: = .*)?", line) or re.fullmatch(
                r"(?!link\.|camera\.)([a-z]\w*(?:\.\w+)*)\.(?!(?:js|py|toml)\b)(\w+)", line
            )
            if named is None or named[1].split(".")[0] not in config.Config.__struct_fields__:
                continue
            kind: typing.Any = config.Config
            for part in [*named[1].split("."), named[2]]:
                assert part in kind.__struct_fields__, f"{document.name}: there is no {line}"
                kind = typing.get_type_hints(kind)[part]
            found += 1
    assert found > 15


def test_links_of_the_documents_lead_somewhere():
    for document in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        # Without what is code: a regular expression may look like a link.
        text = re.sub(r"`[^`\n]*`", "", document.read_text(encoding="utf-8"))
        for target in re.findall(r"\]\(([^)#:]+)\)", text):
            assert (document.parent / target).exists(), f"{document.name} links to {target}"


# Names that may stand in prose as they are: MAVLink's, the system's, a file's.
ALL_CAPS = {
    "VISION_POSITION_ESTIMATE",
    "LOCAL_POSITION_NED",
    "GLOBAL_POSITION_INT",
    "ATTITUDE_QUATERNION",
    "CLOCK_MONOTONIC",
    "NAMED_VALUE_FLOAT",
    "MAV_CMD_EXTERNAL_POSITION_ESTIMATE",
    "ONBOARD_COMPUTER_STATUS",
    "RADIO_STATUS",
    "SOURCE_DATE_EPOCH",
    "THIRD_PARTY_NOTICES",
}


def test_documents_have_no_placeholder_left():
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "config").glob("*.md")]:
        text = document.read_text(encoding="utf-8")
        prose = re.sub(r"^```.*?^```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
        found = set(re.findall(r"\b[A-Z]{3,}(?:_[A-Z]{3,})+\b", prose)) - ALL_CAPS
        assert not found, f"{document.name}: placeholders {sorted(found)}"


def test_modules_that_the_architecture_names_exist():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for name in re.findall(r"`((?:adapters|bench|pipeline|matching|pose|tiles|geometry)/\w+\.py)`", text):
        assert (ROOT / "ortholoc_edge" / name).is_file(), name


# Keys whose value in the example is not the default, since the default is seldom what a vehicle needs.
NOT_THE_DEFAULT = {"camera.latency_ms", "log.folder"}


def test_example_configuration_has_every_key_with_its_default():
    """Unknown keys fail to parse; keys that were forgotten or whose default has moved fail here."""
    example = ROOT / "config" / "example.toml"
    parsed = config.read_config(example)
    text = example.read_text(encoding="utf-8")

    def check(value: msgspec.Struct, prefix: str) -> None:
        for field in msgspec.structs.fields(value):
            key, have = f"{prefix}{field.encode_name}", getattr(value, field.name)
            if isinstance(have, msgspec.Struct):
                check(have, f"{key}.")
                continue
            assert re.search(rf"^(# )?{field.encode_name} = ", text, re.MULTILINE), f"{key} is not in the example"
            if prefix != "intrinsics." and key not in NOT_THE_DEFAULT and not field.required:
                assert have == field.default, f"{key}: the example says {have}, the default is {field.default}"

    check(parsed, "")


def test_example_marks_what_is_not_the_default():
    text = (ROOT / "config" / "example.toml").read_text(encoding="utf-8")
    told = (ROOT / "config" / "README.md").read_text(encoding="utf-8")
    for key in NOT_THE_DEFAULT:
        assert f"`{key}`" in told
        assert re.search(rf"^{key.split('.')[1]} = .*# example \(default", text, re.MULTILINE), key
    assert text.count("# example (default") == len(NOT_THE_DEFAULT)
