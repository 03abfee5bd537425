"""Populations of hands: published measurements of people, drawn as fields of a scene's operator."""

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from os import PathLike
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.bridge.scene.errors import Path, SceneError, closest, shown
from haptether.bridge.scene.load import path_of
from haptether.bridge.scene.sweeps.laws import SampleLaw, generator, law_of, sobol_points
from haptether.bridge.scene.sweeps.limits import out_of_range, whole_number
from haptether.bridge.scene.sweeps.scenes import SCENE
from haptether.bridge.scene.tables.session import Scene
from haptether.input_file import read_text

Array: TypeAlias = npt.NDArray[np.float64]

_SHIPPED = FilePath(__file__).parents[2] / "populations"
MAX_BYTES = 1 << 18
"""Largest population file."""
_DIMENSION = "population "
"""Prefix of the names of its random numbers; no scene path begins with it."""
_PICK = _DIMENSION + "hands"


def _spring_damper(drawn: Mapping[str, Array]) -> dict[str, Array]:
    """`F_h = K (target - x) - B V`, used directly."""
    return {"operator.stiffness": drawn["stiffness"], "operator.damping": drawn["damping"]}


def _grasp_and_arm(drawn: Mapping[str, Array]) -> dict[str, Array]:
    """`F = (k1 + b1 s) (M s² + b2 s + k2) / (M s² + (b1 + b2) s + k1 + k2) X` below its resonance.

    A grasp k1, b1 connects the stylus to the hand's mass M, and an arm k2, b2 connects M to the ground. To first order
    in s, `F = (K + B s) X` with `K = k1 k2 / (k1 + k2)` and `B = (b1 k2² + b2 k1²) / (k1 + k2)²`.

    Source: Fu and Cavusoglu 2012, Fig. 4 (the model); its Taylor series at s = 0.
    """
    grasp, arm = drawn["grasp_stiffness"], drawn["arm_stiffness"]
    both = grasp + arm
    damping = (drawn["grasp_damping"] * arm**2 + drawn["arm_damping"] * grasp**2) / both**2
    return {"operator.stiffness": grasp * arm / both, "operator.damping": damping}


@dataclass(frozen=True)
class HandModel:
    """Conversion of hand figures to fields of `[operator]`."""

    figures: tuple[str, ...]
    """Required figures: 0 or more, stiffness above 0."""
    fields: Callable[[Mapping[str, Array]], dict[str, Array]]
    """Function from figures by name to fields by path."""


HAND_MODELS: Mapping[str, HandModel] = MappingProxyType({
    "spring-damper": HandModel(("stiffness", "damping"), _spring_damper),
    "grasp-and-arm": HandModel(
        ("grasp_stiffness", "grasp_damping", "arm_stiffness", "arm_damping"), _grasp_and_arm
    ),
})  # fmt: skip
NOT_DRAWN = "mass_kg"
"""Figure that any model may have but no scene uses, because the modelled hand has no mass."""


class FigureSource(Struct, frozen=True, kw_only=True):
    """Origin of figures."""

    source: str
    """Authors, year, title, publication, and location within it."""
    measured: str
    """Measured quantity, method, and meaning of the figures."""
    subjects: int | None
    """Number of people; None if not stated."""
    read_at: str
    """Address at which the figures were read."""
    verified: bool
    """True if read in the publication itself, False if in another's transcription."""


class PopulationHand(Struct, frozen=True, kw_only=True):
    """One person or one condition, whose figures belong together."""

    name: str
    """Unique within the population."""
    model: str
    """Key of `HAND_MODELS`."""
    weight: float
    """Relative weight of the hand in the draws."""
    figures: Mapping[str, SampleLaw]
    """Figures in SI units, by the names of the model."""
    published: FigureSource
    """Origin of the figures."""


class PopulationTrait(Struct, frozen=True, kw_only=True):
    """Field of `[operator]` that is drawn in addition to the hand."""

    field: str
    """Path of the field."""
    law: SampleLaw
    """Law in the unit of the field."""
    published: FigureSource
    """Origin of the law."""


class Population(Struct, frozen=True, kw_only=True):
    """Hands of which each sample picks one by weight and draws its figures; traits are common to all hands."""

    title: str
    """Description."""
    hands: tuple[PopulationHand, ...]
    """One or more hands."""
    traits: tuple[PopulationTrait, ...] = ()
    """Traits, drawn if the scene has the field."""

    @property
    def dimensions(self) -> tuple[str, ...]:
        """Names of the random numbers that a draw needs."""
        figures = dict.fromkeys(figure for hand in self.hands for figure in HAND_MODELS[hand.model].figures)
        return (_PICK, *(_DIMENSION + name for name in (*figures, *(trait.field for trait in self.traits))))

    def draws(
        self, count: int, seed: int = 1, *, scene: Scene | None = None, points: Mapping[str, Array] | None = None
    ) -> dict[str, Array]:
        """Draw hands as samples of a sweep: each picks one of the hands and draws all its figures.

        Each random number depends only on its name and the seed. More draws begin with the same values, and an added
        trait changes no other number. Figures of a hand are drawn independently.

        Args:
            count: Number of hands.
            seed: Seed of the draws, 0 or more.
            scene: Scene whose missing parts exclude their traits; by default no trait is excluded.
            points: Values between 0 and 1 by name of `dimensions`, shape `(count,)` each; by default random numbers.

        Returns:
            Values by dotted path, each of shape (count,).

        Raises:
            SceneError: The scene has no `[operator]`.
        """
        if scene is not None and scene.operator is None:
            message = "a population: the scene has no [operator]; add it before drawing hands"
            raise SceneError(message)

        def values(name: str, law: SampleLaw) -> Array:
            if points is not None:
                return law.quantile(points[_DIMENSION + name])
            return law.draw(generator(seed, _DIMENSION + name), count)

        weights = np.cumsum([hand.weight for hand in self.hands])
        share = points[_PICK] if points is not None else generator(seed, _PICK).random(count)
        picked = np.minimum(np.searchsorted(weights, share * weights[-1], side="right"), len(self.hands) - 1)
        drawn: dict[str, Array] = {}
        for number, hand in enumerate(self.hands):
            model = HAND_MODELS[hand.model]
            of_hand = model.fields({name: values(name, hand.figures[name]) for name in model.figures})
            for path, column in of_hand.items():
                drawn[path] = np.where(picked == number, column, drawn.get(path, np.nan))
        for trait in self.traits:
            if scene is None or _has(scene, path_of(trait.field)):
                drawn[trait.field] = values(trait.field, trait.law)
        return drawn


def _has(scene: Scene, path: Path) -> bool:
    """Return True if a scene has a field, or omits it or its table."""
    part: Any = scene
    for step in path:
        if isinstance(step, int):
            part = part[step] if isinstance(part, tuple) and step < len(part) else None
        else:
            part = getattr(part, step, None)
    return part is not None


def with_population(
    scene: Scene,
    samples: Mapping[str, Any] | None,
    population: "Population | str | PathLike[str] | None",
    seed: int = 1,
    *,
    sobol: bool = False,
) -> Mapping[str, Any] | None:
    """Return the samples with one hand of a population per sample.

    If scenes vary, the first scene decides which fields are drawn.

    Raises:
        SceneError: The file is not a population, or the scene has no hand.
        ValueError: No samples, an invalid seed, or a population field that is also sampled.
        ImportError: `sobol` requires SciPy.
    """
    seed = whole_number("seed", seed, 0)
    if population is None:
        return samples
    if not samples:
        message = "population: give samples, for example run.seed: as many hands are drawn"
        raise ValueError(message)
    hands = population if isinstance(population, Population) else load_population(population)
    count = len(next(iter(samples.values())))
    points = sobol_points(hands.dimensions, count, seed) if sobol else None
    drawn = hands.draws(count, seed, scene=scene, points=points)
    refuse_both(drawn, samples)
    return {**drawn, **samples}


def refuse_both(drawn: Iterable[str], others: Iterable[str]) -> None:
    """Refuse a field that both a population and another argument give; varied scenes are exempt.

    Raises:
        ValueError: Names the first such field.
    """
    given = {path_of(path) for path in others if path != SCENE}
    for path in drawn:
        if path_of(path) in given:
            message = f"{path}: is drawn from the population, and given: leave one out"
            raise ValueError(message)


def population_names() -> tuple[str, ...]:
    """Return the names of the shipped populations."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def load_population(name_or_path: str | PathLike[str]) -> Population:
    """Read a population.

    Args:
        name_or_path: One of `population_names()`, or the path of a TOML file.

    Raises:
        SceneError: The file does not exist or is not a population; gives the file, the hand or trait, and the key.
    """
    if not isinstance(name_or_path, str | PathLike):
        message = (
            f"population = {shown(name_or_path)}: must be the name of a shipped population or the path of a TOML file"
        )
        raise SceneError(message)
    path = FilePath(name_or_path)
    if str(name_or_path) in population_names():
        path = _SHIPPED / f"{name_or_path}.toml"
    elif str(name_or_path) and path.is_dir():
        message = f"{path}: is a folder, must be the name of a shipped population or a TOML file"
        raise SceneError(message)
    elif path.suffix != ".toml" and path.is_file():
        message = f"{path}: must end in .toml, or be the name of a shipped population"
        raise SceneError(message)
    elif path.suffix != ".toml":
        seen = str(name_or_path) or '""'
        message = f"{seen}: no such population: {closest(str(name_or_path), population_names())}"
        raise SceneError(message)
    try:
        return _population(tomllib.loads(read_text(path, MAX_BYTES)), path.parent)
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
    except ValueError as error:
        message = f"{path.name}: {error}"
    except RecursionError:
        message = f"{path.name}: tables or lists too deep within each other"
    raise SceneError(message)


def _population(raw: Mapping[str, Any], folder: FilePath) -> Population:
    _refuse_unknown("population", raw, ("title", "hands", "traits"))
    hands = tuple(_hand(f"hands.{place}", each, folder) for place, each in enumerate(_tables(raw, "hands")))
    traits = tuple(_trait(f"traits.{place}", each, folder) for place, each in enumerate(_tables(raw, "traits")))
    if not hands:
        message = "hands: must be one table [[hands]] or more"
        raise SceneError(message)
    for what, names in (("hands", [each.name for each in hands]), ("traits", [each.field for each in traits])):
        if twice := {name for name in names if names.count(name) > 1}:
            message = f"{what}: {min(twice)} is there twice"
            raise SceneError(message)
    return Population(title=_text("population", raw, "title"), hands=hands, traits=traits)


def _tables(raw: Mapping[str, Any], key: str) -> Sequence[Mapping[str, Any]]:
    tables = raw.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(each, dict) for each in tables):
        message = f"{key} = {shown(tables)}: must be tables [[{key}]]"
        raise SceneError(message)
    return tables


_PUBLISHED = ("source", "measured", "subjects", "read_at", "verified")


def _published(place: str, raw: Mapping[str, Any]) -> FigureSource:
    subjects, verified = raw.get("subjects"), raw.get("verified")
    if subjects is not None and (not isinstance(subjects, int) or isinstance(subjects, bool) or subjects < 1):
        raise _wrong(place, "subjects", subjects, "a whole number of 1 or more")
    if not isinstance(verified, bool):
        raise _wrong(place, "verified", verified, "true or false")
    source, measured, read_at = (_text(place, raw, key) for key in ("source", "measured", "read_at"))
    return FigureSource(source=source, measured=measured, subjects=subjects, read_at=read_at, verified=verified)


def _hand(place: str, raw: Mapping[str, Any], folder: FilePath) -> PopulationHand:
    _refuse_unknown(place, raw, ("name", "model", "weight", "figures", *_PUBLISHED))
    name, model = _text(place, raw, "name"), _text(place, raw, "model")
    place = f"{place} ({name})"
    if model not in HAND_MODELS:
        raise _wrong(place, "model", model, f"one of {', '.join(HAND_MODELS)}")
    weight = raw.get("weight", 1.0)
    if not _is_number(weight) or weight <= 0.0:
        raise _wrong(place, "weight", weight, "a finite number above 0")
    figures = raw.get("figures")
    if not isinstance(figures, dict):
        raise _wrong(place, "figures", figures, "a table of figures")
    known = HAND_MODELS[model].figures
    _refuse_unknown(f"{place}.figures", figures, (*known, NOT_DRAWN))
    if missing := [figure for figure in known if figure not in figures]:
        message = f"{place}.figures: {missing[0]} is missing: the model {model} takes {', '.join(known)}"
        raise SceneError(message)
    laws = {figure: _law(f"{place}.figures", figure, value, folder) for figure, value in figures.items()}
    for figure, law in laws.items():
        low = law.support[0]
        if low < 0.0 or (figure.endswith("stiffness") and low == 0.0 and law.name != "lognormal"):
            least = "above 0" if figure.endswith("stiffness") else "0 or more"
            raise _wrong(f"{place}.figures", figure, figures[figure], f"{least} throughout")
    return PopulationHand(name=name, model=model, weight=float(weight), figures=laws, published=_published(place, raw))


def _trait(place: str, raw: Mapping[str, Any], folder: FilePath) -> PopulationTrait:
    _refuse_unknown(place, raw, ("field", "law", *_PUBLISHED))
    field = _text(place, raw, "field")
    place = f"{place} ({field})"
    try:
        path = path_of(field)
    except SceneError as error:
        message = f"{place}: {error}"
        raise SceneError(message) from None
    if path[0] != "operator" or field.replace("-", "_") in {"operator.stiffness", "operator.damping"}:
        raise _wrong(place, "field", field, "a number of [operator] other than stiffness and damping")
    law = _law(place, "law", raw.get("law"), folder)
    # A lognormal law never reaches its lower end, and rows above the range are refused one by one.
    ends = [] if law.name == "lognormal" else [end for end in law.support if isfinite(end)]
    if len(ends) < 2 and law.name != "lognormal":
        raise _wrong(place, "law", raw["law"], "a law whose values have bounds")
    if outside := out_of_range(path, np.array(ends)):
        message = f"{place}: law: {next(iter(outside.values()))}"
        raise SceneError(message)
    return PopulationTrait(field=".".join(map(str, path)), law=law, published=_published(place, raw))


def _law(place: str, key: str, value: object, folder: FilePath) -> SampleLaw:
    if _is_number(value):
        return SampleLaw("constant", (float(cast("float", value)),))
    if not isinstance(value, str):
        raise _wrong(place, key, value, "a finite number, or a law as --draw has it, in quotes")
    try:
        return law_of(value, folder)
    except ValueError as error:
        message = f"{place}: {key}: {error}"
        raise SceneError(message) from None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _text(place: str, raw: Mapping[str, Any], key: str) -> str:
    value = raw.get(key)
    if not isinstance(value, str) or not value.strip():
        raise _wrong(place, key, value, "a text")
    return value


def _refuse_unknown(place: str, raw: Mapping[str, Any], known: Sequence[str]) -> None:
    for key in raw:
        if key not in known:
            message = f"{place}: no key {key}: {closest(key, known)}"
            raise SceneError(message)


def _wrong(place: str, key: str, seen: object, allowed: str) -> SceneError:
    if seen is None:
        return SceneError(f"{place}: {key} is missing: must be {allowed}")
    return SceneError(f"{place}: {key} = {shown(seen)}: must be {allowed}")
