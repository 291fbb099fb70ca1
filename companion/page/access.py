"""Rights of whoever asks: sessions by pairing codes, and tokens that only this page can hand out.

Whoever is on this machine may look on without a code. All else needs a session: a signed cookie
that says which right its code gave. It lasts until the codes are renewed; it has no time in it,
since a drone without a battery clock does not know the time.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from pathlib import Path

from itsdangerous import BadSignature, URLSafeSerializer

from companion.errors import SourceError
from companion.page.codes import FILE, Codes, new_codes, plain, read_codes, write_codes
from companion.timing.rate_limit import PeerLimit

COOKIE = "companion"
KEPT_S = 30 * 86400
"""Time for which a browser keeps a session."""
ONE_PEER, ALL_PEERS = (1 / 12, 5.0), (1 / 3, 20.0)
"""Attempts with a code, of one peer and of all: a second, and at once."""
MOST_PEERS = 256
"""Peers that are remembered."""


class Right(IntEnum):
    """Rights; each includes the lower ones."""

    NONE = 0
    LOOK = 1
    CHANGE = 2


@dataclass(frozen=True, slots=True)
class Session:
    """A session: its right, and the name that its tokens are made of."""

    right: Right
    name: str


class Access:
    """Judges sessions and codes; `flights` is the folder that has them, `clock` gives seconds."""

    def __init__(self, flights: Path, clock: Callable[[], float], say: Callable[[str], None]):
        self._flights, self._say = flights, say
        self._stamp: tuple[int, int] | None = None
        self._codes = self._first_codes()
        self._attempts, self._clock = PeerLimit(ONE_PEER, ALL_PEERS, MOST_PEERS), clock

    def session(self, cookie: str | None, peer: str) -> Session:
        """The session of a request, by its cookie and the address it comes from."""
        least = Right.LOOK if is_here(peer) else Right.NONE
        if not cookie:
            return Session(least, "")
        self._look_for_new_codes()
        try:
            right, name = self._signer.loads(cookie)
            return Session(max(Right(right), least), str(name))
        except (BadSignature, ValueError, TypeError):
            return Session(least, "")

    def pair(self, code: str, peer: str) -> str | None:
        """Cookie of a new session; None for a wrong code. PermissionError where tried too often."""
        self._look_for_new_codes()
        if not self._attempts.allows(peer, round(self._clock() * 1e9)):
            raise PermissionError
        given = plain(code).encode()
        right = Right.NONE
        for of_code, wanted in (
            (Right.LOOK, self._codes.look), (Right.CHANGE, self._codes.change),
        ):  # fmt: skip
            if hmac.compare_digest(given, wanted.encode()):
                right = of_code
        if right is Right.NONE:
            return None
        return str(self._signer.dumps([int(right), secrets.token_hex(16)]))

    def token(self, session: Session) -> str:
        """Token that a form of this session sends back."""
        made = hmac.digest(self._codes.secret.encode(), b"form:" + session.name.encode(), "sha256")
        return made.hex()[:32]

    def is_token(self, session: Session, token: str) -> bool:
        """True of the token of this session, which has a name."""
        own = self.token(session).encode()
        return bool(session.name) and hmac.compare_digest(own, token.encode())

    @property
    def _signer(self) -> URLSafeSerializer:
        return URLSafeSerializer(self._codes.secret, salt="session")

    def _first_codes(self) -> Codes:
        try:
            found = read_codes(self._flights)
            if found is None:
                found = new_codes()
                write_codes(self._flights, found)
            self._stamp = self._stamp_now()
            return found
        except (SourceError, OSError) as error:
            self._say(f"the codes of the page cannot be kept, nobody can pair: {error}")
            return new_codes()

    def _look_for_new_codes(self) -> None:
        """Take over codes that were renewed: all sessions end."""
        stamp = self._stamp_now()
        if stamp is None or stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            self._codes = read_codes(self._flights) or self._codes
        except SourceError as error:
            self._say(str(error))

    def _stamp_now(self) -> tuple[int, int] | None:
        try:
            found = (self._flights / FILE).stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_ino


@lru_cache(MOST_PEERS)
def is_here(peer: str) -> bool:
    """True of an address of this machine."""
    try:
        address = ipaddress.ip_address(peer.partition("%")[0])
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback
