"""Access control of the console: only its own page, with the token of the address."""

import hmac
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADERS = {
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}


class Guard:
    """Refuses requests under another host name, from another origin, or without the token.

    A page of another site in the same browser can neither read nor command. Its `Origin` differs; if its name resolves
    to this machine, the `Host` differs. It does not know the token, which is the first part of every path.

    Args:
        inner: Application behind the guard; it sees the path without the token.
        port: Port on which the console listens.
        token: Token of the address.
        admit: Called with the scope of each request that has the token.
    """

    def __init__(self, inner: "ASGIApp", port: int, token: str, admit: "Callable[[Scope], None]") -> None:
        self._inner = inner
        self._admit = admit
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        self._prefix = f"/{token}/".encode()
        sources = " ".join(f"ws://{host}" for host in sorted(self._hosts))
        policy = (
            f"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;"
            f" connect-src 'self' {sources}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        self._headers = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
        self._headers.append((b"content-security-policy", policy.encode()))

    async def __call__(self, scope: "Scope", receive: "Receive", send: "Send") -> None:
        """Pass accepted requests on; answer others with 403."""
        if scope["type"] not in {"http", "websocket"}:
            return
        refused = self._refused(scope)
        if refused is None:
            self._admit(scope)
            path = scope["path"][len(self._prefix) - 1 :]
            scope = {**scope, "path": path, "raw_path": path.encode("ascii", "replace")}
            await self._inner(scope, receive, self._with_headers(send))
        elif scope["type"] == "websocket":
            # Closing before accepting makes the browser receive 403.
            await send({"type": "websocket.close", "code": 1008, "reason": refused})
        else:
            # Close regardless of further data: no client without the token keeps a connection.
            headers = [*self._headers, (b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
            await send({"type": "http.response.start", "status": 403, "headers": headers})
            await send({"type": "http.response.body", "body": f"{refused}\n".encode()})

    def _refused(self, scope: "Scope") -> str | None:
        """Reason for a refusal; None for a request of the page itself."""
        headers: dict[bytes, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(bytes(name).lower(), []).append(bytes(value).decode("latin-1"))
        hosts, origins = headers.get(b"host", []), headers.get(b"origin", [])
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return "another name than that of the address"
        # A missing origin is valid only for opening the page or reading one of its files.
        needs_origin = scope["type"] == "websocket" or scope["method"] not in {"GET", "HEAD"}
        if len(origins) != 1 if needs_origin else len(origins) > 1:
            return "no origin"
        if origins and origins[0] != f"http://{hosts[0]}":
            return "another origin"
        sites = headers.get(b"sec-fetch-site", [])
        if any(site not in {"same-origin", "none"} for site in sites):
            return "another site"
        path = scope["path"].encode("utf-8", "replace")
        if not hmac.compare_digest(path[: len(self._prefix)], self._prefix):
            return "not the address that the console printed"
        return None

    def _with_headers(self, send: "Send") -> "Send":
        async def sending(message: "Message") -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *self._headers]}
            await send(message)

        return sending
