"""Requests to a proxy that runs, and what it answers."""

import difflib
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import msgspec
from msgspec.structs import replace

from haptether._core import ProxyStatistics
from haptether.netsim.link.errors import LinkError, of_types, refuse_infinite
from haptether.netsim.link.resolve import link_json
from haptether.netsim.link.settings import DISTRIBUTIONS, Direction, LinkSettings

_LONGEST_LIST = 100
"""Values of a list that are told; a recording may have millions."""


class _Changing(Protocol):
    """What a request changes: a proxy."""

    def change(self, direction: Direction, settings: LinkSettings) -> None: ...

    def statistics(self) -> ProxyStatistics: ...


class Controlled:
    """A running proxy whose links change by requests, each a line of JSON.

    `{"forward": {"delay_s": 0.1}, "backward": {...}}` changes these settings and leaves the others; `null` puts one
    back to what it is if it is left out. `{"show": true}`, also beside a change, asks for settings and statistics. A
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
        """Does what a request says and gives the answer, and whether whoever sent it may go on.

        The answer has `ok`, with `error` where that is false; `changed` has the old and the new value of each setting
        that was named, by direction. A line that is no JSON may come from a browser that was sent here: what follows
        it is not to count.
        """
        try:
            return {"ok": True, **self._done(line)}, True
        except ValueError as error:
            return refused_line(str(error)), not isinstance(error, _NotJsonError)

    def _done(self, line: bytes) -> dict[str, Any]:
        request = _read(line)
        changed = {way: _changed(link, request[way], way) for way, link in self._links.items() if way in request}
        # Only once all of it is known to be right.
        for way, settings in changed.items():
            self._proxy.change(way, settings)
        before = dict(self._links)
        self._links |= changed
        changes = {way: _change(before[way], link, request[way]) for way, link in changed.items()}
        answer: dict[str, Any] = {"changed": changes} if changes else {}
        if not request.get("show", False):
            return answer
        links: dict[str, Any] = {way: _told(msgspec.to_builtins(link)) for way, link in self._links.items()}
        return {**answer, **links, "statistics": self._report(self._proxy.statistics())}


def _change(before: LinkSettings, after: LinkSettings, keys: Iterable[str]) -> dict[str, Any]:
    """What the settings that a request names were and are; none for one that nobody gives."""

    def value(link: LinkSettings, key: str) -> Any:  # noqa: ANN401  # as different as the settings are
        return _told(msgspec.to_builtins(getattr(link, key)))

    return {key: {"old": value(before, key), "new": value(after, key)} for key in keys}


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


def _changed(link: LinkSettings, request: dict[str, Any], way: Direction) -> LinkSettings:
    """The link with other settings, all held against their rules.

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
            asked = msgspec.convert(request, LinkSettings)
        except msgspec.ValidationError as error:
            raise of_types(error, request, LinkSettings) from None
        _refuse_files(asked)
        settings = replace(link, **{name: getattr(asked, name) for name in request})
        link_json(settings, way)
    except LinkError as error:
        raise LinkError(f"{way}.{error.key}", error.problem) from None
    return settings


def _refuse_files(asked: LinkSettings) -> None:
    """Whoever asks is not to learn what files of the proxy's user say."""
    for name in ("trace", "opportunities"):
        if getattr(getattr(asked, name), "file", None) is not None:
            raise LinkError(f"{name}.file", ": a running proxy reads no files; give the numbers")
    if isinstance(asked.distribution, str) and asked.distribution not in DISTRIBUTIONS:
        raise LinkError("distribution", f' = "{asked.distribution[:80]}": must be one of {", ".join(DISTRIBUTIONS)}')


def _told(value: Any) -> Any:  # noqa: ANN401  # as different as the settings are
    """Settings without what would fill the answer."""
    if isinstance(value, dict):
        return {name: _told(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_told(item) for item in value] if len(value) <= _LONGEST_LIST else f"{len(value)} values"
    return value
