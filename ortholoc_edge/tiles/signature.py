"""Who made a pack: an Ed25519 signature over the bytes of its manifest, raw in `manifest.sig`.

The manifest has the SHA-256 of every file, so the signature covers the pack. It does not say that a pack is the
newest, nor that it is the one for today's area: an old pack that was signed once stays signed.
Keys are PEM files as OpenSSL writes them.
"""

from __future__ import annotations

import functools
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, SIGNATURE_NAME, manifest_bytes, parse_manifest

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

logger = logging.getLogger(__name__)

PASSPHRASE_VARIABLE = "ORTHOLOC_KEY_PASSPHRASE"
_SIGNATURE_BYTES = 64
_OTHERS_READ = 0o044


def sign(folder: Path, private_key: Path) -> None:
    """Sign a pack: write `manifest.sig` in one step, over the one that is there.

    Raises: MapError without a manifest or where the folder cannot be written; ConfigError for an unusable key.
    """
    signer(private_key)(folder)


def signer(private_key: Path) -> Callable[[Path], None]:
    """:func:`sign` with a key that is read now, before the hours that a pack may take. Raises: as that."""
    return functools.partial(_sign, key=_private_key(private_key))


def _sign(folder: Path, key: Ed25519PrivateKey) -> None:
    manifest = manifest_bytes(folder / MANIFEST_NAME)
    # Only what is a pack: a signature must not be had for anything.
    parse_manifest(manifest, folder / MANIFEST_NAME)
    signature = key.sign(manifest)
    path = folder / SIGNATURE_NAME
    try:
        handle, name = tempfile.mkstemp(prefix=f".{SIGNATURE_NAME}.", dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(signature)
                file.flush()
                # Whoever may read the manifest may read its signature; mkstemp is for the owner alone.
                os.fchmod(file.fileno(), (folder / MANIFEST_NAME).stat().st_mode & 0o666)
                os.fsync(file.fileno())
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        _sync_folder(folder)
    except OSError as err:
        raise MapError(f"{path}: cannot be written ({err.strerror}); check the folder's permissions") from err


def require(folder: Path, public_key: Path) -> bytes:
    """The bytes of a pack's manifest, whose signature is that key's; what is parsed must be these bytes.

    Raises: MapError for a pack without manifest or without a signature by that key; ConfigError for an unusable key.
    """
    manifest = manifest_bytes(folder / MANIFEST_NAME)
    path = folder / SIGNATURE_NAME
    try:
        signature = path.read_bytes()
    except FileNotFoundError as err:
        raise MapError(
            f"{folder}: not signed, {SIGNATURE_NAME} is missing, and {public_key} is required;"
            " sign the pack with: ortholoc-edge tiles sign"
        ) from err
    except OSError as err:
        raise MapError(f"{path}: cannot be read ({err.strerror}); check its permissions") from err
    verify_bytes(manifest, signature, public_key, path)
    return manifest


def verify_bytes(manifest: bytes, signature: bytes, public_key: Path, path: Path) -> None:
    """Check a signature over a manifest's bytes; ``path`` of the signature is for messages.

    Raises: MapError if it is not that key's over these bytes; ConfigError for an unusable key.
    """
    key = _public_key(public_key)
    from cryptography.exceptions import InvalidSignature

    if len(signature) != _SIGNATURE_BYTES:
        raise MapError(
            f"{path}: {len(signature)} bytes, an Ed25519 signature has {_SIGNATURE_BYTES};"
            " copy the pack again or sign it again"
        )
    try:
        key.verify(signature, manifest)
    except InvalidSignature as err:
        raise MapError(
            f"{path}: not the signature of {public_key} over {MANIFEST_NAME}: the manifest was changed or another key"
            " signed it; get the pack again from whoever made it, or check which key is theirs"
        ) from err


def generate(prefix: Path) -> tuple[Path, Path]:
    """Write a new key pair: the private key to ``PREFIX.pem``, for its owner alone, the public to ``PREFIX.pub.pem``.

    The private key is encrypted if ``$ORTHOLOC_KEY_PASSPHRASE`` is set.
    Returns: both paths.
    Raises: ConfigError if one of them is there or cannot be written.
    """
    _require_library()
    from cryptography.hazmat.primitives import serialization as form
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    private, public = (prefix.with_name(prefix.name + end) for end in (".pem", ".pub.pem"))
    for path in (private, public):
        if path.exists():
            raise ConfigError(f"{path}: is there already; name another prefix, or remove it if nothing needs it")
    phrase = _passphrase()
    encryption = form.NoEncryption() if phrase is None else form.BestAvailableEncryption(phrase)
    key = Ed25519PrivateKey.generate()
    secret = key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, encryption)
    open_part = key.public_key().public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo)
    for path, data, mode in ((private, secret, 0o600), (public, open_part, 0o644)):
        try:
            # Never readable by others, not even for a moment, and never over another key.
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        except OSError as err:
            raise ConfigError(f"{path}: cannot be written ({err.strerror}); name another prefix") from err
    return private, public


def _private_key(path: Path) -> Ed25519PrivateKey:
    _require_library()
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    data = _key_bytes(path, "private")
    if path.stat().st_mode & _OTHERS_READ:
        logger.warning("%s: others than its owner can read this private key; restrict it with: chmod 600", path)
    try:
        try:
            key = load_pem_private_key(data, None)
        except TypeError:
            # The library's way to say that it is encrypted.
            phrase = _passphrase()
            if phrase is None:
                raise ConfigError(
                    f"{path}: encrypted; put its passphrase into the environment as {PASSPHRASE_VARIABLE}"
                ) from None
            key = load_pem_private_key(data, phrase)
    except (ValueError, UnsupportedAlgorithm) as err:
        raise ConfigError(
            f"{path}: no private key in PEM, or {PASSPHRASE_VARIABLE} is not its passphrase ({err});"
            " make a key with: ortholoc-edge tiles keygen"
        ) from err
    if not isinstance(key, Ed25519PrivateKey):
        raise ConfigError(f"{path}: not an Ed25519 key; make one with: ortholoc-edge tiles keygen")
    return key


def _public_key(path: Path) -> Ed25519PublicKey:
    _require_library()
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    data = _key_bytes(path, "public")
    if b"PRIVATE KEY" in data:
        raise ConfigError(f"{path}: a private key; keep it where packs are made, and name the public one here")
    try:
        key = load_pem_public_key(data)
    except (ValueError, UnsupportedAlgorithm) as err:
        raise ConfigError(f"{path}: no public key in PEM ({err}); copy it again from whoever makes the packs") from err
    if not isinstance(key, Ed25519PublicKey):
        raise ConfigError(f"{path}: not an Ed25519 key; name the one that belongs to the packs' private key")
    return key


def _key_bytes(path: Path, which: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as err:
        raise ConfigError(f"{path}: {which} key cannot be read ({err.strerror}); correct the path") from err


def _passphrase() -> bytes | None:
    phrase = os.environ.get(PASSPHRASE_VARIABLE)
    return phrase.encode() if phrase else None


def _require_library() -> None:
    # Late and optional: who signs nothing and requires no signature needs none of it.
    try:
        import cryptography  # noqa: F401
    except ImportError as err:
        raise ConfigError("signatures need the package cryptography; pip install 'ortholoc-edge[sign]'") from err


def _sync_folder(folder: Path) -> None:
    """Make a replacement last through a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
