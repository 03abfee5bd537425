"""Run of one scene in virtual time, and its result."""

import time
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from os import PathLike
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Struct, convert, json

from haptether import _core
from haptether._core import LoopReport
from haptether.bridge.scene.errors import SceneError
from haptether.bridge.scene.load import Checked, checked_scene, loaded
from haptether.bridge.scene.research import research_of
from haptether.bridge.scene.swing import contact_swing_n
from haptether.bridge.scene.tables.session import Scene
from haptether.private_file import private_file, refuse_link

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import xarray
    from matplotlib.figure import Figure

SLAVE_SIGNALS = ("slave_", "environment_", "gripper", "holds_object", "handle_", "hole_", "body_")
"""Prefixes of signals that use `slave_time_s`, because the slave's period may differ from the master's."""
TIMES = {"master": "time_s", "slave": "slave_time_s"}
"""Signal with the tick times of each side."""
AXES = "xyz"
QUATERNION = "wxyz"


class Signals(Mapping[str, npt.NDArray[Any]]):
    """Recorded signals by name or as an attribute: one array per signal, with `time_s` as its first axis."""

    def __init__(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        self._arrays = MappingProxyType(dict(arrays))

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        if name not in self._arrays:
            message = f"no signal {name!r}: there is {', '.join(self._arrays) or 'none, the scene has no [record]'}"
            raise KeyError(message)
        return self._arrays[name]

    def __getattr__(self, name: str) -> npt.NDArray[Any]:
        # During unpickling no arrays exist yet, and the lookup would recurse.
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def time_of(self, name: str) -> str:
        """Return the time signal of another signal: "time_s" or "slave_time_s"."""
        if "slave_time_s" not in self._arrays:
            # In a scene with one loop the environment ticks with its master.
            return "time_s"
        return "slave_time_s" if name.startswith(SLAVE_SIGNALS) or "time_s" not in self._arrays else "time_s"

    def between(self, begin_s: float, end_s: float) -> "Signals":
        """Return the signals from `begin_s` to `end_s` in s, both included, each by its own times."""

        def cut(name: str) -> npt.NDArray[Any]:
            times = self[name] if name in {"time_s", "slave_time_s"} else self[self.time_of(name)]
            return self[name][(times >= begin_s) & (times <= end_s)]

        return Signals({name: cut(name) for name in self})

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._arrays]

    def __reduce__(self) -> tuple[type["Signals"], tuple[dict[str, npt.NDArray[Any]]]]:
        return Signals, (dict(self._arrays),)

    def __repr__(self) -> str:
        return f"Signals({', '.join(f'{name}: {array.shape}' for name, array in self._arrays.items())})"


class Event(Struct, frozen=True):
    """Single event of a run."""

    time_s: float
    """Time in s since the start."""
    kind: str
    """Kind of event: a trip, a ladder transition, "diverged", ..."""
    detail: str
    """Controller, or reason."""


class Metrics(Struct, frozen=True, kw_only=True):
    """Figures of a run; None if a figure does not apply or was not measured, which differs from 0."""

    outcome: str = "complete"
    """Outcome: complete, settled, diverged, not-released (before the release), never-engaged, or the ladder state in
    which master and slave were no longer coupled.
    """

    max_ejection_velocity: float | None = None
    """MEV: largest speed in m/s after the release, away from the pressed object.

    For a hand that follows aims, only the time in which it is open counts.
    """
    peak_device_force: float | None = None
    """Largest |F_device| in N."""
    time_to_trip_s: float | None = None
    """Time in s from the release to the first intervention after it."""
    false_trips: int | None = None
    """Number of interventions that began while the hand held."""
    intervention_s: float | None = None
    """Time under intervention in s."""
    position_rmse_m: float | None = None
    """Root mean square error in m between the slave's position and the scaled position of the master."""
    force_rmse_n: float | None = None
    """Root mean square error in N between the device force and the scaled reading of the slave's sensor."""
    max_ejection_rate: float | None = None
    """Largest angular speed in rad/s of the device after the release; kind "pose" only, like the next three."""
    peak_device_torque: float | None = None
    """Largest |tau_device| in N m."""
    orientation_rmse_rad: float | None = None
    """Root mean square angle in rad between the slave's rotation and the scaled rotation of the master."""
    torque_rmse_n_m: float | None = None
    """Root mean square error in N m between the device torque and the scaled reading of the slave's sensor."""
    passivity_min_j: float | None = None
    """Minimum over time, in J, of the net energy absorbed by the force rendering; below 0: active."""
    diverged: bool = False
    """True if device or arm left their bounds, or a number became invalid; the run ended there."""
    ticks: int = 0
    """Number of master ticks."""
    wall_time_s: float = 0.0
    """Computation time in s."""


class Run(Struct, frozen=True, kw_only=True):
    """Result of a scene."""

    scene: str
    """Name or title of the scene."""
    seed: int
    """Seed of all random numbers."""
    version: str
    """Haptether version. The same scene, seed and version give the same numbers."""
    signals: Signals
    """Signals that `[record]` keeps; empty without that table."""
    events: tuple[Event, ...]
    """Events in time order."""
    metrics: Metrics
    """Figures of the run."""
    reports: tuple[LoopReport, LoopReport] | None = None
    """Loop reports of master and slave, as from live loops; None without an arm, and after unpickling."""
    specification: bytes = b""
    """Scene as JSON, with defaults and presets filled in; empty for a recording without a scene."""

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings by table, with defaults and presets filled in; empty for a recording without a scene."""
        return dict(json.decode(self.specification)) if self.specification else {}

    @property
    def contact_swing_n(self) -> float | None:
        """Swing of the device force in N that does not settle before the release or the end; None if it does."""
        releases = [event.time_s for event in self.events if event.kind == "release"]
        return contact_swing_n(self.signals, releases)

    def save(self, path: str | PathLike[str]) -> None:
        """Write every signal as an array of a NumPy `.npz` file with mode 0600.

        Raises:
            OSError: The file cannot be written, or is a symbolic link.
        """
        arrays: dict[str, Any] = dict(self.signals)
        target = FilePath(path)
        refuse_link(target)
        with private_file(target) as file:
            np.savez_compressed(file, **arrays)

    def columns(self, side: Literal["master", "slave"] = "master") -> dict[str, npt.NDArray[Any]]:
        """Return the signals of one side, one array of shape `(n_ticks,)` per column.

        Names end in `_x`, `_y`, `_z` or a number for an axis, and in `_w`, `_x`, `_y`, `_z` for a quaternion.

        Raises:
            ValueError: The side was not recorded.
        """
        time = TIMES.get(side)
        if time not in self.signals:
            there = [repr(name) for name, of_side in TIMES.items() if of_side in self.signals]
            message = f"side = {side!r}: was not recorded; there is {' and '.join(there) or 'none: no [record]'}"
            raise ValueError(message)
        columns = {}
        for name, values in self.signals.items():
            if self.signals.time_of(name) != time:
                continue
            if values.ndim == 1:
                columns[name] = values
            else:
                for label, axis in zip(axis_names(name, values.shape[1]), values.T, strict=True):
                    columns[f"{name}_{label}"] = axis
        return columns

    def to_polars(self, side: Literal["master", "slave"] = "master") -> "pl.DataFrame":
        """Return the columns of one side as a Polars data frame.

        Raises:
            ImportError: Polars (extra `analysis`) is not installed.
            ValueError: The side was not recorded.
        """
        import polars as pl  # noqa: PLC0415

        return pl.DataFrame(self.columns(side))

    def to_pandas(self, side: Literal["master", "slave"] = "master") -> "pd.DataFrame":
        """Return the columns of one side as a pandas data frame, indexed by time in s.

        Raises:
            ImportError: pandas is not installed; no extra includes it.
            ValueError: The side was not recorded.
        """
        import pandas as pd  # noqa: PLC0415

        columns = self.columns(side)
        return pd.DataFrame(columns).set_index(TIMES[side])

    def to_xarray(self) -> "xarray.Dataset":
        """Return every signal over `time_s` or `slave_time_s`, and over `x`, `y`, `z` or axis numbers.

        Raises:
            ImportError: xarray is not installed; no extra includes it.
        """
        import xarray  # noqa: PLC0415

        variables: dict[str, tuple[tuple[str, ...], npt.NDArray[Any]]] = {}
        coordinates: dict[str, npt.NDArray[Any]] = {}
        for name, values in self.signals.items():
            time = self.signals.time_of(name)
            if name == time:
                coordinates[name] = values
            elif values.ndim == 1:
                variables[name] = ((time,), values)
            else:
                labels = axis_names(name, values.shape[1])
                axis = "quaternion" if labels[0] == "w" else "axis"
                coordinates[axis] = np.array(labels)
                variables[name] = ((time, axis), values)
        about = {"scene": self.scene, "seed": self.seed, "version": self.version}
        return xarray.Dataset(variables, coordinates, attrs=about)

    def plot(self, path: str | PathLike[str] | None = None, *, columns: Literal[1, 2] = 2) -> "Figure":
        """Draw the run like `haptether simulate --plot`, and write it if a path is given.

        Args:
            path: Target file, .png, .pdf or .svg; None writes no file.
            columns: Width in page columns: 3.5 or 7.16 inches.

        Raises:
            ImportError: matplotlib (extra `analysis`) is not installed.
            ValueError: The run has no signals, or the file has another suffix.
            OSError: The file cannot be written, or is a symbolic link.
        """
        from haptether.view.figures.run import draw_run  # noqa: PLC0415
        from haptether.view.style.figure import check_columns, check_picture, write_figure  # noqa: PLC0415

        check_columns(columns)
        if path is not None:
            check_picture(FilePath(path))
        figure = draw_run(self, columns)
        if path is not None:
            write_figure(figure, FilePath(path))
        return figure

    def _repr_html_(self) -> str:
        from haptether.bridge.scene.notebook import as_html  # noqa: PLC0415

        return as_html(self)

    def __reduce__(self) -> tuple[Any, ...]:
        # Reports belong to the process of the run.
        kept = {name: getattr(self, name) for name in self.__struct_fields__ if name != "reports"}
        return partial(Run, **kept), ()


def axis_names(name: str, axes: int) -> list[str]:
    """Return the names of a signal's axes: x, y, z; w, x, y, z for a quaternion; numbers from 0 for more axes."""
    if name.endswith("orientation"):
        return list(QUATERNION)
    return list(AXES[:axes]) if axes <= len(AXES) else [str(axis) for axis in range(axes)]


def named_scene(scene: Scene | str | PathLike[str], overrides: Iterable[str]) -> tuple[str, Checked]:
    """Return the name of a scene, and the scene with its overrides.

    Raises:
        SceneError: The scene is invalid.
    """
    if isinstance(scene, Scene):
        return scene.title or "scene", checked_scene(scene, overrides)
    return str(scene), loaded(scene, overrides)


def _check_record(record: tuple[str | PathLike[str], str | PathLike[str]] | None) -> None:
    """Refuse a value that is not a pair of files.

    Raises:
        SceneError: Gives the form, or the file that occurs twice.
    """
    if record is None:
        return
    if not (
        isinstance(record, tuple) and len(record) == 2 and all(isinstance(file, str | PathLike) for file in record)
    ):
        message = f'record = {record!r}: must be two files, of master and slave, such as ("master.mcap", "slave.mcap")'
        raise SceneError(message)
    master, slave = (FilePath(file) for file in record)
    if master.resolve() == slave.resolve():
        message = f"record: master and slave both name {slave}: give two files"
        raise SceneError(message)


def simulate(
    scene: Scene | str | PathLike[str],
    *,
    overrides: Iterable[str] = (),
    record: tuple[str | PathLike[str], str | PathLike[str]] | None = None,
) -> Run:
    """Run a scene in virtual time.

    Args:
        scene: A `Scene`, the name of a shipped scene, or the path of a TOML file.
        overrides: Fields to change, `table.key=value` each.
        record: MCAP files for master and slave, same as `--record` of live sides, with every tick; by default none.

    Raises:
        SceneError: The scene is invalid or has no two sides to record, or a file cannot be written.
    """
    name, checked = named_scene(scene, overrides)
    _check_record(record)
    specification = checked.json
    research = research_of(checked.scene)
    begun = time.perf_counter()
    try:
        done = _core.simulate_scene(specification, record, research)
    except ValueError as error:
        # Some conditions, such as the combined stiffness, show only after assembly.
        raise SceneError(str(error)) from None
    took = time.perf_counter() - begun
    return Run(
        scene=name,
        seed=checked.scene.run.seed,
        version=_core.__version__,
        signals=Signals(done.signals),
        events=tuple(Event(*event) for event in done.events),
        metrics=convert({"wall_time_s": took, **done.metrics}, Metrics),
        reports=done.reports,
        specification=specification,
    )
