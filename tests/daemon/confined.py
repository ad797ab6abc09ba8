"""Runs ``ortholoc-edge`` as the unit's ``SystemCallFilter=`` and ``MemoryDenyWriteExecute=`` would have it, but that a
forbidden system call ends it at once: ``python confined.py GROUP… -- ARGUMENTS…``, a group with ``~`` is taken away.

systemd compiles the same filter; here there is no systemd to do it.
"""

from __future__ import annotations

import ctypes
import os
import re
import struct
import subprocess
import sys
from pathlib import Path

_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _PR_SET_MDWE = 38, 22, 65
_SECCOMP_FILTER = 2
_LOAD, _EQUAL, _RETURN = 0x20, 0x15, 0x06
_ALLOW, _KILL = 0x7FFF0000, 0x80000000
HEADER = Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h")


def numbers() -> dict[str, int]:
    return {
        name: int(number) for name, number in re.findall(r"#define __NR_(\w+)\s+(\d+)", HEADER.read_text("utf-8"))
    }


def members(group: str) -> set[str]:
    """System calls of a group, with those of the groups in it."""
    printed = subprocess.run(
        ["systemd-analyze", "syscall-filter", "--no-pager", group], capture_output=True, text=True, check=True
    ).stdout
    found: set[str] = set()
    for word in re.findall(r"^    ([@\w-]+)$", printed, re.MULTILINE):
        found |= members(word) if word.startswith("@") else {word}
    return found


def confine(allowed: set[str]) -> None:
    known = numbers()
    # Offset 0 of the data is the number.
    program = [(_LOAD | 0x00, 0, 0, 0)]
    for name in sorted(allowed & set(known)):
        program += [(_EQUAL, 0, 1, known[name]), (_RETURN, 0, 0, _ALLOW)]
    program.append((_RETURN, 0, 0, _KILL))
    code = b"".join(struct.pack("HBBI", *instruction) for instruction in program)
    buffer = ctypes.create_string_buffer(code)
    header = struct.pack("HxxxxxxP", len(program), ctypes.addressof(buffer))
    libc = ctypes.CDLL(None, use_errno=True)
    for call in (
        (_PR_SET_MDWE, 1, 0, 0, 0),
        (_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0),
        (_PR_SET_SECCOMP, _SECCOMP_FILTER, ctypes.c_char_p(header), 0, 0),
    ):
        if libc.prctl(*call) != 0:
            sys.exit(f"prctl{call[:2]}: {os.strerror(ctypes.get_errno())}")


if __name__ == "__main__":
    where = sys.argv.index("--")
    allowed: set[str] = set()
    for group in sys.argv[1:where]:
        allowed = allowed - members(group[1:]) if group.startswith("~") else allowed | members(group)
    confine(allowed)
    # Only now: what is imported must do with it, too.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ortholoc_edge.cli import main

    sys.exit(main(sys.argv[where + 1 :]))
