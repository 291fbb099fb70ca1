"""Pairing codes, and the secret that signs sessions: a file beside the flights.

There is no default: both codes are drawn when the page first starts. Whoever may read the file,
the daemon's user and its group, may read them with `companion page`.
"""

from __future__ import annotations

import json
import secrets
from dataclasses import asdict, dataclass
from pathlib import Path

from companion.errors import SourceError
from companion.products.atomic_file import write_atomically

FILE = ".page-codes.json"
LETTERS = "ABCDEFGHJKMNPQRSTUVWXYZ23456789"
"""Without those that are taken for one another."""
N_LETTERS = 8
"""40 bits: at one attempt in three seconds (`access`) a guess takes 50 000 years."""
MODE = 0o640


@dataclass(frozen=True, slots=True)
class Codes:
    """Secret of the sessions, the code to look on, and the code to change things."""

    secret: str
    look: str
    change: str


def new_codes() -> Codes:
    """Codes that nobody knows yet."""
    look, change = ("".join(secrets.choice(LETTERS) for _ in range(N_LETTERS)) for _ in "12")
    return Codes(secrets.token_hex(32), look, change)


def read_codes(flights: Path) -> Codes | None:
    """Codes of the page; None where there are none yet. SourceError where they cannot be read."""
    path = flights / FILE
    try:
        found = json.loads(path.read_bytes())
        return Codes(*(str(found[name]) for name in ("secret", "look", "change")))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SourceError(
            f"{path}: {error.strerror or error}; join the group companion, or use sudo"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise SourceError(f"{path}: damaged; `companion page --new-codes` makes others") from error


def write_codes(flights: Path, codes: Codes) -> None:
    """Keep codes, readable for the owner and the group only; OSError."""
    flights.mkdir(parents=True, exist_ok=True)
    path, data = flights / FILE, json.dumps(asdict(codes)).encode() + b"\n"
    # drawn by root, they are still the daemon's to read
    write_atomically(path, data, durable=True, like=path if path.exists() else None, mode=MODE)


def plain(code: str) -> str:
    """A code as somebody typed it, without spaces and dashes, in capitals."""
    return "".join(letter for letter in code.upper() if letter.isalnum())


def shown(code: str) -> str:
    """A code in two groups of four."""
    return f"{code[: N_LETTERS // 2]}-{code[N_LETTERS // 2 :]}"
