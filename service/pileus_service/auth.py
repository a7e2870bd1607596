"""Who may call: on the loopback anyone, elsewhere the bearer of a token that has the role.

A token is NAME.SECRET with a secret of 256 random bits, shown once; the data folder keeps its
SHA-256 alone, which for so many bits is as good as a slow hash.
"""

import hashlib
import hmac
import ipaddress
import re
import secrets
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from pileus_service.errors import InputError
from pileus_service.jobs import Record
from pileus_service.problems import Problem
from pileus_service.store import write_whole

NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
FAILURES_A_MINUTE = 20


class Role(StrEnum):
    """What a token may do; each may also do what those before it may."""

    READ = "read"
    SUBMIT = "submit"
    ADMIN = "admin"

    def may(self, needed: "Role") -> bool:
        order = list(Role)
        return order.index(self) >= order.index(needed)


_NEEDED = {"GET": Role.READ, "HEAD": Role.READ, "DELETE": Role.ADMIN}


class TokenRecord(Record):
    """What is kept of a token: tokens/NAME.json."""

    name: str
    role: Role
    created: float
    digest: str


class Tokens:
    """The tokens of a data folder, a file each: made and revoked while services run."""

    def __init__(self, data: Path) -> None:
        self._folder = data / "tokens"

    def create(self, name: str, role: Role) -> str:
        """Makes a token and returns it; it is not to be had again."""
        if not NAME.fullmatch(name):
            raise InputError(f"token {name!r}: a name is of a-z, 0-9 and -, at most 64 of them")
        secret = secrets.token_urlsafe(32)
        record = TokenRecord(name=name, role=role, created=time.time(), digest=_digest(secret))
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not write_whole(self._file(name), record.model_dump_json().encode(), once=True):
            raise InputError(f"token {name}: is there already; revoke it or take another name")
        return f"{name}.{secret}"

    def revoke(self, name: str) -> None:
        """From the next request on the token is no longer known."""
        if not NAME.fullmatch(name) or not self._file(name).exists():
            raise InputError(f"token {name!r}: there is none; see pileus token list")
        self._file(name).unlink()

    def all(self) -> list[TokenRecord]:
        """By name; damaged files are left out, as they let nobody in."""
        names = sorted(path.stem for path in self._folder.glob("*.json"))
        return [record for name in names if (record := self._read(name))]

    def bearer(self, token: str) -> TokenRecord | None:
        """The record of a token; None for a wrong, revoked or mangled one."""
        name, _, secret = token.partition(".")
        record = self._read(name) if NAME.fullmatch(name) else None
        # Compared in constant time, and for an unknown name as well.
        same = hmac.compare_digest(_digest(secret), record.digest if record else _digest(""))
        return record if record and same else None

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.json"

    def _read(self, name: str) -> TokenRecord | None:
        try:
            return TokenRecord.model_validate_json(self._file(name).read_bytes())
        except (FileNotFoundError, ValidationError):
            return None


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


_Bearer = HTTPBearer(auto_error=False, description="TOKEN of `pileus token create`")
Credentials = Annotated[HTTPAuthorizationCredentials | None, Security(_Bearer)]


class Guard:
    """A dependency of every route that tells or changes anything.

    GET needs the role read, DELETE and what steers workers admin, all else submit. Without tokens
    (None, or for a direct caller of a `local` service) the loopback alone is let in.
    """

    def __init__(self, tokens: Tokens | None = None, *, local: bool = False) -> None:
        self._tokens = tokens
        self._local = local
        self._failures = MovingWindowRateLimiter(MemoryStorage())
        self._bound = RateLimitItemPerMinute(FAILURES_A_MINUTE)

    async def __call__(self, request: Request, credentials: Credentials) -> None:
        _refuse_foreign_page(request)
        # What a proxy on this host passes on comes from anywhere.
        forwarded = "x-forwarded-for" in request.headers or "forwarded" in request.headers
        if self._tokens is None or (self._local and not forwarded):
            # A page of another site that resolves its name to us is not a local user.
            if forwarded or not is_loopback(request.url.hostname or ""):
                raise Problem(403, "Only the loopback may call without a token")
            return
        # A thread for the token's file; who needs none is spared it.
        role = await run_in_threadpool(self._role, self._tokens, request, credentials)
        needed = _NEEDED.get(request.method, Role.SUBMIT)
        if needed is Role.SUBMIT and request.url.path.startswith("/v1/workers/"):
            needed = Role.ADMIN
        if not role.may(needed):
            raise Problem(403, f"This token's role is {role}; this call needs {needed}")

    def _role(self, tokens: Tokens, request: Request, credentials: Credentials) -> Role:
        caller = _network(request.client.host if request.client else "")
        if not self._failures.test(self._bound, caller):
            raise Problem(
                429, "Too many wrong tokens from this address; wait", headers={"Retry-After": "60"}
            )
        record = tokens.bearer(credentials.credentials) if credentials else None
        if record is None:
            if credentials:
                self._failures.hit(self._bound, caller)
            raise Problem(
                401,
                "A valid token is required: Authorization: Bearer TOKEN",
                headers={"WWW-Authenticate": "Bearer"},
            )
        return record.role


def _refuse_foreign_page(request: Request) -> None:
    """A browser names the page that calls; those of other sites have no business here."""
    origin = request.headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != request.headers.get("host"):
        raise Problem(403, "Pages of other sites may not call this service")


def _network(address: str) -> str:
    """Who counts as one caller: an IPv4 address, in whatever clothes, the /64 of an IPv6 one."""
    try:
        parsed = ipaddress.ip_address(address)
        if isinstance(parsed, ipaddress.IPv6Address):
            return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False))
        return address
    except ValueError:
        return address


def guard_for(host: str, data: Path) -> Guard:
    """The guard for a listening address; beyond the loopback there must be a token."""
    tokens = Tokens(data)
    local = is_loopback(host)
    if not local and not tokens.all():
        raise InputError(
            f"--listen {host}: callers beyond the loopback need a token and there is none yet; "
            f"make one: pileus token create NAME --role admin --data {data}"
        )
    return Guard(tokens, local=local)
