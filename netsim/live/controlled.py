"""Requests to a running proxy, and their answers."""

import difflib
from collections.abc import Callable
from typing import Any, Protocol

import msgspec
from msgspec.structs import replace

from haptether._core import ProxyStatistics
from haptether.netsim.link.errors import LinkError, of_types, refuse_infinite
from haptether.netsim.link.resolve import link_json
from haptether.netsim.link.settings import DISTRIBUTIONS, Direction, LinkSettings

_MAX_LISTED = 100
"""Largest list in an answer; a recording may have millions of values."""


class _Changing(Protocol):
    """Proxy changed by a request."""

    def change(self, direction: Direction, settings: LinkSettings) -> None: ...

    def statistics(self) -> ProxyStatistics: ...


class Controlled:
    """Running proxy whose links change by requests, each a line of JSON.

    `{"forward": {"delay_s": 0.1}, "backward": {...}}` changes the given settings only; `null` resets one to its
    default. `{"show": true}`, alone or with a change, requests settings and statistics. A request is applied entirely
    or not at all.

    Args:
        proxy: Proxy to change.
        forward: Current link to the peer.
        backward: Current link from the peer.
        report: Converts statistics to builtin types.
    """

    def __init__(
        self,
        proxy: _Changing,
        forward: LinkSettings,
        backward: LinkSettings,
        report: Callable[[ProxyStatistics], dict[str, Any]],
    ) -> None:
        self._proxy = proxy
        self._links: dict[Direction, LinkSettings] = {"forward": forward, "backward": backward}
        self._report = report

    def answer(self, line: bytes) -> tuple[dict[str, Any], bool]:
        """Execute a request; return the answer, and True if the connection may stay open.

        The answer has `ok`, and `error` if that is false. `changed` holds the old and new value of each named setting
        by direction. A line that is not JSON may come from a misdirected browser, so later lines must be ignored.
        """
        try:
            return {"ok": True, **self._carried_out(line)}, True
        except ValueError as error:
            return refused_line(str(error)), not isinstance(error, _NotJsonError)

    def _carried_out(self, line: bytes) -> dict[str, Any]:
        request = _read(line)
        links = {name: link for name, link in self._links.items() if name in request}
        changed = {name: _changed(link, request[name], name) for name, link in links.items()}
        # Apply only after the whole request is valid.
        for name, settings in changed.items():
            self._proxy.change(name, settings)
        self._links |= changed
        changes = {
            name: {key: {"old": _value(link, key), "new": _value(changed[name], key)} for key in request[name]}
            for name, link in links.items()
        }
        answer: dict[str, Any] = {"changed": changes} if changes else {}
        if not request.get("show", False):
            return answer
        shown: dict[str, Any] = {name: _abridged(msgspec.to_builtins(link)) for name, link in self._links.items()}
        return {**answer, **shown, "statistics": self._report(self._proxy.statistics())}


def _value(link: LinkSettings, key: str) -> Any:  # noqa: ANN401  # as different as the settings are
    return _abridged(msgspec.to_builtins(getattr(link, key)))


def _read(line: bytes) -> dict[str, Any]:
    try:
        request = msgspec.json.decode(line)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        message = f"no JSON: {error}"
        raise _NotJsonError(message) from None
    names = ("forward", "backward", "show")
    if not isinstance(request, dict) or not request:
        message = f"request: must be an object with {', '.join(names)}"
        raise ValueError(message)
    for name, value in request.items():
        if name not in names:
            message = f"{name[:80]}: a request has only {', '.join(names)}"
            raise ValueError(message)
        kind, allowed = (bool, "true or false") if name == "show" else (dict, "an object of settings")
        if not isinstance(value, kind):
            message = f"{name}: must be {allowed}"
            raise ValueError(message)
    return request


class _NotJsonError(ValueError):
    """Line that was not meant for this socket."""


def refused_line(why: str) -> dict[str, Any]:
    """Return the answer to a refused request."""
    return {"ok": False, "error": " ".join(why.split())}


def _changed(link: LinkSettings, request: dict[str, Any], direction: Direction) -> LinkSettings:
    """Return the link with changed settings, all checked.

    Raises:
        LinkError: Names the first invalid setting.
    """
    try:
        for name in request:
            if name not in link.__struct_fields__:
                near = difflib.get_close_matches(name, link.__struct_fields__, n=1, cutoff=0.5)
                raise LinkError(name, f": there is no such setting{f': did you mean {near[0]}?' if near else ''}")
        refuse_infinite(request)
        try:
            requested = msgspec.convert(request, LinkSettings)
        except msgspec.ValidationError as error:
            raise of_types(error, request, LinkSettings) from None
        _refuse_files(requested)
        settings = replace(link, **{name: getattr(requested, name) for name in request})
        link_json(settings, direction)
    except LinkError as error:
        raise LinkError(f"{direction}.{error.key}", error.problem) from None
    return settings


def _refuse_files(requested: LinkSettings) -> None:
    """Refuse files, so that a client cannot read files of the proxy's user."""
    for name in ("trace", "opportunities"):
        if getattr(getattr(requested, name), "file", None) is not None:
            raise LinkError(f"{name}.file", ": a running proxy reads no files; give the numbers")
    if isinstance(requested.distribution, str) and requested.distribution not in DISTRIBUTIONS:
        raise LinkError(
            "distribution", f' = "{requested.distribution[:80]}": must be one of {", ".join(DISTRIBUTIONS)}'
        )


def _abridged(value: Any) -> Any:  # noqa: ANN401  # as different as the settings are
    """Shorten long lists in settings."""
    if isinstance(value, dict):
        return {name: _abridged(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_abridged(item) for item in value] if len(value) <= _MAX_LISTED else f"{len(value)} values"
    return value
