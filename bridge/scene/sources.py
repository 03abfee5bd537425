"""Sources of the methods that a scene uses, read where they stand: registries, presets and docstrings.

A table's docstring has `Source: TEXT`. The docstring of a field ends with `Source: TEXT` for any value, or with
`Source of VALUE: TEXT` for one value.
"""

import ast
import inspect
import re
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import chain, pairwise

from msgspec import Struct
from msgspec.structs import replace

from haptether._core import COUPLINGS
from haptether.bridge.scene.research import maker_of
from haptether.bridge.scene.tables.session import CouplingTable, Scene
from haptether.netsim import PRESETS, LinkSettings
from haptether.netsim.link.resolve import with_preset
from haptether.netsim.link.settings import Direction
from haptether.safety import CONTROLLERS, ESTIMATORS, OBSERVERS

OBSERVER_OF = {"vfc": "vfo", "hsc": "hgo", "wsc": "wso", "pc": "po"}
"""Observer of each controller."""
SOURCE = re.compile(r"\bSource(?: of (?P<value>\S+))?:\s+(?P<text>.+?)\s*(?=\n\n|\bSource\b|\Z)", re.DOTALL)
AUTHORED = re.compile(
    r"((?:[A-Z][a-z][\w-]*(?:, | and ))*[A-Z][a-z][\w-]*)( et al\.)? ((?:(?:18|19|20)\d\d(?:, )?)+)\b"
)
CLAUSE_END = re.compile(r"; (?![^(]*\))")
TITLE = "Safety Control for Impedance Haptic Interfaces"
"""The publication that sources call "paper"."""
PAPER = re.compile(r"\bpaper (?:Eq\.|section)")


class MethodSource(Struct, frozen=True, kw_only=True):
    """Method of a scene with its source."""

    part: str
    """Table or field of the scene."""
    name: str = ""
    """Name of the method, where the field takes one of several."""
    title: str = ""
    """Short description."""
    source: str

    @property
    def used_as(self) -> str:
        """Part, name and description."""
        return ", ".join(filter(None, (f"{self.part} {self.name}".strip(), self.title)))


def scene_sources(scene: Scene) -> tuple[MethodSource, ...]:
    """Return the sources of a scene's observers, controllers, estimator, coupling, network, hand, contact and solver.

    Args:
        scene: As of `load_scene`.
    """
    links = () if scene.link is None else _links({"forward": scene.link.forward, "backward": scene.link.backward})
    # The tables of the link are those of its preset, too.
    found = chain(_safety(scene), _coupling(scene), links, _tables(replace(scene, link=None), ""))
    return tuple(dict.fromkeys(found))


def bibtex(methods: tuple[MethodSource, ...]) -> str:
    """Return an entry for each publication with authors and year, with the words of the source as its note.

    Titles and venues stand in no registry, so an entry has none. A source without authors or year becomes a comment.
    The note has the part of the source that names the publication.

    Args:
        methods: As of `scene_sources`.
    """
    entries: dict[str, tuple[dict[str, str], dict[str, None]]] = {}
    comments = list[str]()
    for method in methods:
        for clause in CLAUSE_END.split(method.source):
            cited = list(AUTHORED.finditer(clause))
            note = f"{method.used_as}: {clause}"
            for authors, others, years in (match.groups() for match in cited):
                names = [*re.split(r", | and ", authors), *(["others"] if others else [])]
                for year in re.findall(r"\d+", years):
                    fields = {"author": " and ".join(names), "year": year}
                    entries.setdefault(f"{''.join(names).lower()}{year}", (fields, {}))[1][note] = None
            if PAPER.search(clause):
                entries.setdefault("paper", ({"title": f"{{{TITLE}}}"}, {}))[1][note] = None
            elif not cited:
                comments.append(f"% {note}")
    texts = [
        f"@misc{{{key},\n"
        + "".join(f"  {name} = {{{value}}},\n" for name, value in fields.items())
        + f"  note = {{{_escaped('; '.join(uses))}}},\n}}"
        for key, (fields, uses) in entries.items()
    ]
    return "\n\n".join([*texts, *(["\n".join(comments)] if comments else [])]) + "\n"


def _escaped(text: str) -> str:
    return re.sub(r"([%&#_$])", r"\\\1", text).replace("²", "2")


def _safety(scene: Scene) -> Iterator[MethodSource]:
    controllers, observers = _by_name(CONTROLLERS), _by_name(OBSERVERS)
    for table, part in (
        (scene.safety, "[safety]"),
        (scene.safety.rotation, "[safety.rotation]"),
        (scene.safety.gripper, "[safety.gripper]"),
    ):
        for name in (table.controllers if table is not None else None) or ():
            if (observer := OBSERVER_OF.get(name)) is not None:
                yield MethodSource(part=f"{part} observer", **observers[observer])
            yield MethodSource(part=f"{part} controllers", **controllers[name])
    research = scene.safety.research
    if research is not None:
        texts = _sources(inspect.getdoc(maker_of(research.controller)) or "")
        source = texts.get(None, "no Source line in its docstring")
        yield MethodSource(part="[safety.research] controller", name=research.controller, source=source)
    if scene.safety.signals == "estimated":
        estimator = str(scene.safety.estimator.__struct_config__.tag)
        yield MethodSource(part="[safety.estimator] kind", **_by_name(ESTIMATORS)[estimator])


def _coupling(scene: Scene) -> Iterator[MethodSource]:
    if scene.slave is not None:
        kind = (scene.coupling or CouplingTable()).kind
        yield MethodSource(part="[coupling] kind", **_by_name(COUPLINGS)[kind])


def _links(links: Mapping[Direction, LinkSettings | None]) -> Iterator[MethodSource]:
    for direction, settings in links.items():
        if settings is None:
            continue
        if settings.preset is not None:
            preset = PRESETS[settings.preset]
            part = f"[link.{direction}] preset"
            yield MethodSource(part=part, name=settings.preset, title=preset.title, source=preset.source)
        effective = with_preset(settings, direction)
        if effective.jitter_s and effective.distribution is None and effective.trace is None:
            effective = replace(effective, distribution="normal")
        yield from _tables(effective, f"link.{direction}")


def _tables(table: Struct, path: str) -> Iterator[MethodSource]:
    """Yield the sources in the docstrings of a table, of its set fields, and of the tables in it."""
    kind = type(table)
    doc = inspect.getdoc(kind) or ""
    subject = doc.partition("\n")[0].rpartition("`: ")[2].partition(".")[0].strip()
    if (source := _sources(doc).get(None)) is not None:
        yield MethodSource(part=f"[{path}]", title=subject, source=source)
    fields = _field_docs(kind)
    for name in kind.__struct_fields__:
        value = getattr(table, name)
        texts = _sources(fields.get(name, ""))
        text = texts.get(value) if isinstance(value, str) and value in texts else texts.get(None)
        if text is not None and value not in (None, 0, ()):
            yield MethodSource(part=f"[{path}] {name}", name=value if value in texts else "", source=text)
        for item in value if isinstance(value, tuple) else (value,):
            if isinstance(item, Struct):
                yield from _tables(item, f"{path}.{name}" if path else name)


def _sources(doc: str) -> dict[str | None, str]:
    return {match["value"]: " ".join(match["text"].split()).removesuffix(".") for match in SOURCE.finditer(doc)}


def _by_name(registry: tuple[tuple[str, str, str], ...]) -> dict[str, dict[str, str]]:
    return {name: {"name": name, "title": title, "source": source} for name, title, source in registry}


@cache
def _field_docs(kind: type) -> dict[str, str]:
    """Return the docstring below each field of a class; empty without its source file."""
    try:
        module = ast.parse(inspect.getsource(sys.modules[kind.__module__]))
    except OSError:
        return {}
    (body,) = (node.body for node in module.body if isinstance(node, ast.ClassDef) and node.name == kind.__name__)
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }
