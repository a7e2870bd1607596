"""Who may call: anyone on the loopback, else the bearer of the token, of which we keep a hash."""

import hashlib
import hmac
import ipaddress
import secrets
from pathlib import Path

from fastapi import Request

from pileus_service.problems import Problem
from pileus_service.store import write_whole


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


class Guard:
    """A dependency of every route that tells or changes anything."""

    def __init__(self, token_hash: str | None) -> None:
        self._token_hash = token_hash

    def __call__(self, request: Request) -> None:
        if self._token_hash is None:
            # A page of another site that resolves its name to us is not a local user.
            if not is_loopback(request.url.hostname or ""):
                raise Problem(403, "Only the loopback may call without a token")
            return
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() != "bearer" or not hmac.compare_digest(_digest(token), self._token_hash):
            raise Problem(
                401,
                "A valid token is required: Authorization: Bearer TOKEN",
                headers={"WWW-Authenticate": "Bearer"},
            )


def guard_for(host: str, data: Path) -> tuple[Guard, str | None]:
    """The guard for a listening address, and the token where one had to be made: shown once."""
    if is_loopback(host):
        return Guard(None), None
    kept = data / "token.sha256"
    if kept.exists():
        return Guard(kept.read_text().strip()), None
    token = secrets.token_urlsafe(32)
    write_whole(kept, _digest(token).encode())
    kept.chmod(0o600)
    return Guard(_digest(token)), token
