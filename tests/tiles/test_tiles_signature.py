"""Signatures: OpenSSL's and ours in both directions, every kind of tampering, and who may read what."""

from __future__ import annotations

import argparse
import logging
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from lattice_tiles import DOP_LATTICE, write_pack

from ortholoc_edge.cli import run, tiles_sign
from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, SIGNATURE_NAME
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.signature import PASSPHRASE_VARIABLE, generate, require, sign, verify_bytes
from ortholoc_edge.tiles.store import MapStore

pytest.importorskip("cryptography", reason="the extra `sign` is not installed")

needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")


def openssl(*arguments):
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True, timeout=60)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return write_pack(tmp_path_factory.mktemp("signature") / "pack").folder


@pytest.fixture
def pack(source, tmp_path):
    return shutil.copytree(source, tmp_path / "pack")


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    return generate(tmp_path_factory.mktemp("keys") / "survey")


@pytest.fixture
def signed(pack, keys):
    sign(pack, keys[0])
    return pack


def test_a_signed_pack_gives_the_bytes_that_were_signed(signed, keys):
    assert require(signed, keys[1]) == (signed / MANIFEST_NAME).read_bytes()
    assert (signed / SIGNATURE_NAME).stat().st_size == 64


def test_signing_again_replaces_the_signature_and_leaves_nothing_else(signed, keys, tmp_path):
    other = generate(tmp_path / "other")
    before = {path.name for path in signed.iterdir()}
    sign(signed, other[0])
    require(signed, other[1])
    with pytest.raises(MapError):
        require(signed, keys[1])
    assert {path.name for path in signed.iterdir()} == before


def test_the_signature_is_read_by_whoever_may_read_the_manifest(pack, keys):
    (pack / MANIFEST_NAME).chmod(0o644)
    sign(pack, keys[0])
    assert stat.S_IMODE((pack / SIGNATURE_NAME).stat().st_mode) == 0o644


def change_manifest(folder):
    path = folder / MANIFEST_NAME
    path.write_bytes(path.read_bytes().replace(b'"max_m": 407.0', b'"max_m": 408.0'))


def append_space(folder):
    with (folder / MANIFEST_NAME).open("ab") as file:
        file.write(b" ")


def flip_bit(folder):
    path = folder / SIGNATURE_NAME
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))


@pytest.mark.parametrize(
    ("tamper", "message"),
    [
        (change_manifest, r"not the signature of .*survey\.pub\.pem over manifest\.json"),
        (append_space, "the manifest was changed or another key"),
        (flip_bit, "the manifest was changed or another key"),
        (lambda folder: (folder / SIGNATURE_NAME).unlink(), "not signed, .* sign the pack with"),
        (lambda folder: (folder / SIGNATURE_NAME).write_bytes(b""), "0 bytes, an Ed25519 signature has 64"),
        (lambda folder: (folder / SIGNATURE_NAME).write_bytes(b"\0" * 64), "not the signature"),
        (lambda folder: (folder / SIGNATURE_NAME).write_bytes(b"\0" * 65), "65 bytes"),
        (lambda folder: (folder / MANIFEST_NAME).unlink(), "no area pack, manifest.json is missing"),
    ],
)
def test_tampering_is_refused_by_name(signed, keys, tamper, message):
    before = {path.name: path.read_bytes() for path in signed.iterdir() if path.is_file()}
    tamper(signed)
    after = {path.name: path.read_bytes() for path in signed.iterdir() if path.is_file()}
    assert before != after
    with pytest.raises(MapError, match=message):
        require(signed, keys[1])


def test_another_key_is_refused(signed, tmp_path):
    with pytest.raises(MapError, match="another key signed it"):
        require(signed, generate(tmp_path / "other")[1])


def test_what_is_no_pack_is_not_signed(pack, keys):
    (pack / MANIFEST_NAME).write_text("{}")
    with pytest.raises(MapError, match=r"manifest\.json"):
        sign(pack, keys[0])
    assert not (pack / SIGNATURE_NAME).exists()


def test_a_pack_is_opened_with_the_bytes_that_were_verified(signed, keys, monkeypatch):
    sound = (signed / MANIFEST_NAME).read_bytes()

    def swapped(*arguments):
        verify_bytes(*arguments)
        change_manifest(signed)

    monkeypatch.setattr("ortholoc_edge.tiles.signature.verify_bytes", swapped)
    assert Pack.open(signed, keys[1]).manifest.dsm.tiles[0].max_m == 407.0
    assert (signed / MANIFEST_NAME).read_bytes() != sound
    assert Pack.open(signed).manifest.dsm.tiles[0].max_m == 408.0


def test_an_unsigned_pack_is_opened_unless_a_key_is_named(pack, keys):
    assert not Pack.open(pack).signed
    with pytest.raises(MapError, match="not signed"):
        Pack.open(pack, keys[1])
    sign(pack, keys[0])
    assert Pack.open(pack, keys[1]).signed


def test_of_a_changed_tile_in_a_signed_pack_nothing_is_used(signed, keys):
    tile = Pack.open(signed).manifest.dop.tiles[0]
    path = signed / tile.file
    data = bytearray(path.read_bytes())
    # The last block is of the full resolution; the CRC-32 of the overviews is still right, as a forger would have it.
    data[-8] ^= 1
    path.write_bytes(data)
    bounds = DOP_LATTICE.grid(tile.box).bounds
    gsd_m = 4 * DOP_LATTICE.pixel_m
    with MapStore(Pack.open(signed)) as store:
        window = store.read(bounds, gsd_m, 1.0)
        assert window.dop_valid.any()
        assert store.damaged == [tile.file]
    with MapStore(Pack.open(signed, keys[1])) as store:
        window = store.read(bounds, gsd_m, 1.0)
        assert window is None or not window.dop_valid.any()
        assert store.damaged == [tile.file]


def test_run_refuses_a_pack_without_the_signature_that_its_configuration_names(pack, keys, tmp_path):
    example = Path(__file__).parents[2] / "config" / "example.toml"
    file = tmp_path / "config.toml"

    def start(public_key):
        lines = [f'public_key = "{public_key}"', f'pack = "{pack}"']
        text = re.sub(r'^pack = "[^"]*"', "\n".join(lines), example.read_text(encoding="utf-8"), flags=re.MULTILINE)
        file.write_text(text, encoding="utf-8")
        return run.run(argparse.Namespace(config=file, verbose=False))

    with pytest.raises(MapError, match="not signed"):
        start(keys[1])
    sign(pack, generate(tmp_path / "other")[0])
    with pytest.raises(MapError, match="another key signed it"):
        start(keys[1])
    sign(pack, keys[0])
    # The next thing that is wrong: no signature any more, but heights that an autopilot can do nothing with.
    with pytest.raises(MapError, match="mean sea level"):
        start(keys[1])
    with pytest.raises(ConfigError, match="public key cannot be read"):
        start(tmp_path / "absent.pem")


@needs_openssl
def test_openssl_verifies_what_we_sign(signed, keys):
    openssl(
        "pkeyutl", "-verify", "-rawin", "-pubin", "-inkey", keys[1],
        "-in", signed / MANIFEST_NAME, "-sigfile", signed / SIGNATURE_NAME,
    )  # fmt: skip


@needs_openssl
def test_we_verify_what_openssl_signs_with_its_own_key(pack, tmp_path):
    private, public = tmp_path / "private.pem", tmp_path / "public.pem"
    openssl("genpkey", "-algorithm", "ed25519", "-out", private)
    openssl("pkey", "-in", private, "-pubout", "-out", public)
    manifest, signature = pack / MANIFEST_NAME, pack / SIGNATURE_NAME
    openssl("pkeyutl", "-sign", "-rawin", "-inkey", private, "-in", manifest, "-out", signature)
    assert require(pack, public) == manifest.read_bytes()
    theirs = signature.read_bytes()
    # Ed25519 has one signature per key and message.
    sign(pack, private)
    assert signature.read_bytes() == theirs


@needs_openssl
def test_an_encrypted_key_of_openssl_needs_its_passphrase(pack, tmp_path, monkeypatch):
    private, public = tmp_path / "private.pem", tmp_path / "public.pem"
    openssl("genpkey", "-algorithm", "ed25519", "-aes-256-cbc", "-pass", "pass:secret", "-out", private)
    openssl("pkey", "-in", private, "-passin", "pass:secret", "-pubout", "-out", public)
    monkeypatch.delenv(PASSPHRASE_VARIABLE, raising=False)
    with pytest.raises(ConfigError, match=f"encrypted; .*{PASSPHRASE_VARIABLE}"):
        sign(pack, private)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "wrong")
    with pytest.raises(ConfigError, match=f"{PASSPHRASE_VARIABLE} is not its passphrase"):
        sign(pack, private)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "secret")
    sign(pack, private)
    require(pack, public)


def test_a_generated_key_is_encrypted_where_there_is_a_passphrase(pack, tmp_path, monkeypatch):
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "päss")
    private, public = generate(tmp_path / "survey")
    assert b"ENCRYPTED" in private.read_bytes()
    sign(pack, private)
    require(pack, public)
    monkeypatch.delenv(PASSPHRASE_VARIABLE)
    with pytest.raises(ConfigError, match="encrypted"):
        sign(pack, private)


def test_a_passphrase_does_no_harm_to_a_key_that_has_none(pack, keys, monkeypatch):
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "secret")
    sign(pack, keys[0])
    require(pack, keys[1])


def test_a_private_key_is_its_owners_and_is_never_overwritten(tmp_path):
    private, public = generate(tmp_path / "a.b")
    assert (private.name, public.name) == ("a.b.pem", "a.b.pub.pem")
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    before = private.read_bytes(), public.read_bytes()
    with pytest.raises(ConfigError, match=r"a\.b\.pem: is there already"):
        generate(tmp_path / "a.b")
    private.unlink()
    with pytest.raises(ConfigError, match=r"a\.b\.pub\.pem: is there already"):
        generate(tmp_path / "a.b")
    assert not private.exists()
    assert public.read_bytes() == before[1]
    with pytest.raises(ConfigError, match="cannot be written"):
        generate(tmp_path / "nowhere" / "key")


def test_a_private_key_that_others_can_read_is_named(pack, keys, tmp_path, caplog):
    loose = tmp_path / "loose.pem"
    loose.write_bytes(keys[0].read_bytes())
    loose.chmod(0o644)
    with caplog.at_level(logging.WARNING, "ortholoc_edge.tiles.signature"):
        sign(pack, keys[0])
        assert not caplog.records
        sign(pack, loose)
    assert [record.getMessage() for record in caplog.records if "chmod 600" in record.getMessage()]


def rsa(folder):
    from cryptography.hazmat.primitives import serialization as form
    from cryptography.hazmat.primitives.asymmetric.rsa import generate_private_key

    key = generate_private_key(65537, 2048)
    private, public = folder / "rsa.pem", folder / "rsa.pub.pem"
    private.write_bytes(key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption()))
    public.write_bytes(key.public_key().public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo))
    return private, public


def test_keys_that_do_not_serve_are_named(signed, keys, tmp_path):
    private, public = rsa(tmp_path)
    garbage = tmp_path / "garbage.pem"
    garbage.write_bytes(b"-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n")
    absent = tmp_path / "absent.pem"
    for key, message in (
        (private, "not an Ed25519 key"),
        (keys[1], "no private key in PEM"),
        (garbage, "no private key in PEM"),
        (absent, "private key cannot be read"),
    ):
        with pytest.raises(ConfigError, match=f"{key.name}: {message}"):
            sign(signed, key)
    for key, message in (
        (public, "not an Ed25519 key"),
        (keys[0], "a private key; keep it where packs are made"),
        (garbage, "no public key in PEM"),
        (absent, "public key cannot be read"),
    ):
        with pytest.raises(ConfigError, match=f"{key.name}: {message}"):
            require(signed, key)


def test_without_the_library_the_remedy_is_said(signed, keys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    for call in (
        lambda: sign(signed, keys[0]),
        lambda: require(signed, keys[1]),
        lambda: verify_bytes(b"", bytes(64), keys[1], signed / SIGNATURE_NAME),
        lambda: generate(signed / "key"),
    ):
        with pytest.raises(ConfigError, match=r"pip install 'ortholoc-edge\[sign\]'"):
            call()


def test_nothing_else_needs_the_library():
    probe = "import sys, ortholoc_edge.tiles.signature; sys.exit('cryptography' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", probe], check=False, timeout=60).returncode == 0


def test_a_folder_that_cannot_be_written_is_named(pack, keys, monkeypatch):
    def refuse(*args, **kwargs):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("ortholoc_edge.tiles.signature.tempfile.mkstemp", refuse)
    with pytest.raises(MapError, match=r"manifest\.sig: cannot be written \(Read-only file system\)"):
        sign(pack, keys[0])


def test_a_crash_while_signing_leaves_the_old_signature(signed, keys, tmp_path, monkeypatch):
    before = (signed / SIGNATURE_NAME).read_bytes()

    def crash(handle):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("ortholoc_edge.tiles.signature.os.fsync", crash)
    with pytest.raises(MapError, match="Input/output error"):
        sign(signed, keys[0])
    assert (signed / SIGNATURE_NAME).read_bytes() == before
    assert not list(signed.glob(".manifest.sig*"))


def test_the_commands_make_keys_and_sign(pack, tmp_path, capsys):
    parser = argparse.ArgumentParser()
    tiles_sign.add_parser(parser.add_subparsers())

    def command(*arguments):
        args = parser.parse_args([str(argument) for argument in arguments])
        assert args.run(args) == 0
        return capsys.readouterr().out.split()

    private, public = command("keygen", "--out", tmp_path / "survey")
    assert command("sign", pack, "--key", private) == [str(pack / SIGNATURE_NAME)]
    require(pack, Path(public))
