"""Flags of a link, the same for every command that has one."""

import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from haptether.cli.shared.assignments import refuse_twice

if TYPE_CHECKING:
    from haptether.netsim import LinkSettings


@dataclass(frozen=True, kw_only=True)
class LinkOptions:
    """Settings of the network; a setting that is not given has no effect."""

    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """A network of `haptether netsim list`."""
    delay_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """Mean one-way delay in s."""
    jitter_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """Standard deviation of the delay in s."""
    jitter_correlation_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """Correlation time of the delay in s."""
    distribution: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """normal, uniform, exponential, gamma, lognormal, pareto, or the path of a .dist file."""
    loss: Annotated[float | None, tyro.conf.arg(metavar="P")] = None
    """Probability that a packet is lost, 0 to 1."""
    mean_burst: Annotated[float | None, tyro.conf.arg(metavar="N")] = None
    """Mean number of packets lost together."""
    reorder: Annotated[float | None, tyro.conf.arg(metavar="P")] = None
    """Probability that a packet overtakes the one before it."""
    duplicate: Annotated[float | None, tyro.conf.arg(metavar="P")] = None
    """Probability that a packet arrives twice."""
    corrupt: Annotated[float | None, tyro.conf.arg(metavar="P")] = None
    """Probability that a bit of a packet is flipped."""
    rate_bps: Annotated[float | None, tyro.conf.arg(metavar="BPS")] = None
    """Rate of the bottleneck in bit/s."""
    queue_ms: Annotated[float | None, tyro.conf.arg(metavar="MS")] = None
    """Longest wait before the bottleneck in ms."""
    trace: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """A recording of delays and losses, of `haptether netsim record` (.csv) or IRTT (.json), instead of a delay. It
    begins at its first record. IRTT without one-way delays counts half of each round trip, and the command says so."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Any setting of a link, in both directions; may be given often. Values are TOML, bare words are strings."""
    backward_set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """The same in the backward direction alone, also as --backward.KEY VALUE; by default it is as forward."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Seed of all draws, by default that of SCENE or 0; the same seed gives the same packets the same fate."""

    def links(self, scene: str | None) -> "Links":
        """Return both directions and the seed; flags take precedence over the scene.

        Raises:
            SceneError: An invalid scene, flag or setting.
        """
        from haptether.bridge.scene.load import of_working_folder, overridden
        from haptether.bridge.scene.unusual import unusual_values
        from haptether.cli.shared.numbers import check_seed

        raw, seed, folder = _read(scene)
        flags = {name: value for name in LINK_FLAGS if (value := getattr(self, name)) is not None}
        self._refuse_twice()
        if self.trace is not None:
            flags["trace"] = {"file": str(self.trace)}
        flags = {name: of_working_folder(value, name) for name, value in flags.items()}
        link: dict[str, Any] = raw.setdefault("link", {})
        for direction in ("forward", "backward"):
            link[direction] = {**link.get(direction, {}), **flags}
        for direction, settings in (("forward", self.set), ("backward", (*self.set, *self.backward_set))):
            for setting in settings:
                raw = overridden(raw, f"link.{direction}.{setting}")
        seed = seed if self.seed is None else self.seed
        check_seed(seed)
        return _typed(raw, folder, seed, unusual_values(raw))

    def _refuse_twice(self) -> None:
        """Refuse a setting that is given twice, also by its own flag and by `--set`: the last would count.

        Raises:
            ValueError: A setting is given twice; the message names both.
        """
        flags = (name for name in LINK_FLAGS if getattr(self, name) is not None)
        given = {name: f"--{name.replace('_', '-')}" for name in flags}
        for setting in self.set:
            key = setting.partition("=")[0].strip().replace("-", "_")
            # The flag of a table also gives the keys of that table.
            table = key.partition(".")[0]
            refuse_twice(given, table if table in given else key, f"--set {key[:80]}")


LINK_FLAGS = tuple(field.name for field in fields(LinkOptions) if field.name not in {"set", "backward_set", "seed"})
"""Flags that are settings of a link, for both directions."""


@dataclass(frozen=True)
class Links:
    """Both directions of a network, and the seed of their draws."""

    forward: "LinkSettings"
    backward: "LinkSettings"
    seed: int
    unusual: list[str]
    """A line for each number whose unit may have slipped, and for delays that are half of round trips."""


def _read(scene: str | None) -> tuple[dict[str, Any], int, Path]:
    """Return the tables of a scene's links, its seed, and the folder of its files."""
    from haptether.bridge import SceneError, load_scene, scene_names

    if scene is None:
        return {}, 0, Path()
    path = Path(scene)
    if scene in scene_names(attacks=True) or path.is_dir() or not path.exists():
        path = _shipped(scene)
    raw = _toml(path)
    if "master" in raw:
        load_scene(scene)  # refuses an invalid scene
        return {"link": raw.get("link", {})}, raw.get("run", {}).get("seed", 0), path.parent
    for key in raw.keys() - {"schema", "title", "shows", "seed", "link"}:
        message = f"{path.name}: {key}: a file of links has only schema, title, shows, seed and [link.*]"
        raise SceneError(message)
    if raw.get("schema") != 1:
        message = f"{path.name}: schema = {raw.get('schema', 'nothing')}: must be 1"
        raise SceneError(message)
    seed = raw.get("seed", 0)
    if not isinstance(seed, int) or isinstance(seed, bool):
        message = f"{path.name}: seed = {seed!r}: must be a whole number"
        raise SceneError(message)
    return {"link": raw.get("link", {})}, seed, path.parent


def _shipped(scene: str) -> Path:
    from haptether.bridge import load_scene
    from haptether.bridge.scene.load import scene_path

    load_scene(scene)
    return scene_path(scene)


def _toml(path: Path) -> dict[str, Any]:
    from haptether.bridge import SceneError
    from haptether.bridge.scene.load import scene_text

    try:
        return tomllib.loads(scene_text(path))
    except ValueError as error:
        message = f"{path.name}: {error}"
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
    raise SceneError(message)


def _typed(raw: dict[str, Any], folder: Path, seed: int, unusual: list[str]) -> Links:
    import msgspec

    from haptether.bridge.scene.errors import explained, refuse_infinite
    from haptether.bridge.scene.resolve import embedded_links, spec_of_links
    from haptether.bridge.scene.tables.session import LinksTable
    from haptether.bridge.scene.unusual import estimated_delays
    from haptether.netsim import LinkSettings

    refuse_infinite(raw)

    class Tables(msgspec.Struct):
        link: LinksTable

    try:
        links = msgspec.convert(raw, Tables).link
    except msgspec.ValidationError as error:
        raise explained(error, raw) from None
    links = embedded_links(links, folder)
    spec_of_links(links)  # refuses settings that contradict each other
    return Links(
        links.forward or LinkSettings(), links.backward or LinkSettings(), seed, unusual + estimated_delays(links)
    )
