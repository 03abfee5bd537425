"""Requests to a proxy that runs, and what it answers."""

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
"""Values of a list that an answer repeats; a recording may have millions."""


class _Changing(Protocol):
    """What a request changes: a proxy."""

    def change(self, direction: Direction, settings: LinkSettings) -> None: ...

    def statistics(self) -> ProxyStatistics: ...


class Controlled:
    """A running proxy whose links change by requests, each a line of JSON.

    `{"forward": {"delay_s": 0.1}, "backward": {...}}` changes these settings and leaves the others; `null` puts one
    back to what it is if it is left out. `{"show": true}`, also beside a change, requests settings and statistics. A
    request counts as a whole or not at all.

    Args:
        proxy: Whose links.
        forward: Its link to the peer as it is.
        backward: Its link from the peer as it is.
        report: Writes statistics as builtin types.
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
        """Carries out a request; returns the answer, and whether the connection may go on.

        The answer has `ok`, with `error` where that is false; `changed` has the old and the new value of each setting
        that was named, by direction. A line that is no JSON may come from a browser that was sent here: what follows
        it is not to count.
        """
        try:
            return {"ok": True, **self._carried_out(line)}, True
        except ValueError as error:
            return refused_line(str(error)), not isinstance(error, _NotJsonError)

    def _carried_out(self, line: bytes) -> dict[str, Any]:
        request = _read(line)
        links = {name: link for name, link in self._links.items() if name in request}
        changed = {name: _changed(link, request[name], name) for name, link in links.items()}
        # Only once all of it is known to be right.
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
    """A line that nobody wrote who meant this socket."""


def refused_line(why: str) -> dict[str, Any]:
    """The answer to a request that was not carried out."""
    return {"ok": False, "error": " ".join(why.split())}


def _changed(link: LinkSettings, request: dict[str, Any], direction: Direction) -> LinkSettings:
    """The link with other settings, all checked.

    Raises:
        LinkError: With the first setting that does not fit.
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
    """A client is not to learn what files of the proxy's user contain."""
    for name in ("trace", "opportunities"):
        if getattr(getattr(requested, name), "file", None) is not None:
            raise LinkError(f"{name}.file", ": a running proxy reads no files; give the numbers")
    if isinstance(requested.distribution, str) and requested.distribution not in DISTRIBUTIONS:
        raise LinkError(
            "distribution", f' = "{requested.distribution[:80]}": must be one of {", ".join(DISTRIBUTIONS)}'
        )


def _abridged(value: Any) -> Any:  # noqa: ANN401  # as different as the settings are
    """Settings without what would fill the answer."""
    if isinstance(value, dict):
        return {name: _abridged(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_abridged(item) for item in value] if len(value) <= _MAX_LISTED else f"{len(value)} values"
    return value
