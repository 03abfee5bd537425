"""Design of a sweep: the value of each path in each row, without a table of all rows."""

import hashlib
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge.scene.errors import Path, SceneError, allowed_at, keys_at, shown
from haptether.bridge.scene.load import path_of
from haptether.bridge.scene.sweeps.limits import EXACT, LARGEST_EXACT, counts_on, takes_numbers
from haptether.bridge.scene.sweeps.scenes import SCENE, SceneChoice

Values: TypeAlias = "Sequence[Any] | npt.NDArray[np.float64]"
"""Values of one path: numbers, or other types that a field takes."""

ALLOWED = "numbers, strings, booleans, lists or tables"
"""Allowed types of values, for messages."""
MOST_SPANNED = 4
"""Largest factor by which a batch grows to keep rows with a common beginning together."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """Full factorial design: every combination of the factors, each with the same samples.

    With N samples, row r has level floor(r / (N n_{f+1} ... n_F)) mod n_f of factor f with n_f levels, and value r mod
    N of each sampled path. The samples vary fastest, then the last factor.
    """

    factors: Mapping[str, npt.NDArray[Any]]
    """Levels by path: float64, or objects if they are not numbers."""
    samples: Mapping[str, npt.NDArray[Any]]
    """Values by path, of equal length."""
    ties: Mapping[str, str]
    """Paths that take the values of another path."""

    def __post_init__(self) -> None:
        lengths = {path: len(values) for path, values in self.samples.items()}
        if len(set(lengths.values())) > 1:
            seen = ", ".join(f"{path} has {length}" for path, length in lengths.items())
            message = f"samples of different lengths: {seen}"
            raise ValueError(message)
        varied = {**self.factors, **self.samples}
        if not varied:
            message = "nothing to vary: give at least one path with values"
            raise ValueError(message)
        if both := self.factors.keys() & self.samples.keys():
            message = f"{min(both)}: is varied and sampled: give one of the two"
            raise ValueError(message)
        for path, leading in self.ties.items():
            if path in varied or leading not in varied:
                problem = "varies by itself" if path in varied else f"{leading} does not vary"
                message = f"{path} is tied to {leading}: {problem}"
                raise ValueError(message)

    @property
    def sampled(self) -> int:
        """Number of rows per combination."""
        return len(next(iter(self.samples.values()))) if self.samples else 1

    @property
    def rows(self) -> int:
        """Number of rows of all combinations."""
        return self.sampled * math.prod(len(levels) for levels in self.factors.values())

    @property
    def span(self) -> int:
        """Number of rows with one level of the fields outside `[safety]`; only these rows may share a beginning."""
        paths = list(self.factors)
        first = next((place for place, path in enumerate(paths) if path.startswith("safety.")), len(paths))
        if first == len(paths):
            return 1
        return self.sampled * math.prod(len(self.factors[path]) for path in paths[first:])

    def end_of_batch(self, first: int, size: int) -> int:
        """Return the end of a batch of about `size` rows that keeps rows with a common beginning together.

        A much larger group of such rows is split.
        """
        end = first + size
        if self.span <= MOST_SPANNED * size:
            end = -(-end // self.span) * self.span
        return min(end, self.rows)

    def columns(self, first: int, end: int) -> dict[str, npt.NDArray[Any]]:
        """Return the values of each path in rows `first` to `end` - 1, shape `(end - first,)`."""
        row = np.arange(first, end)
        whole: dict[str, npt.NDArray[Any]] = {}
        stride = self.rows
        for path, levels in self.factors.items():
            stride //= len(levels)
            whole[path] = levels[row // stride % len(levels)]
        for path, values in self.samples.items():
            whole[path] = values[row % self.sampled]
        return whole | {path: whole[leading] for path, leading in self.ties.items()}

    def described(self) -> dict[str, Any]:
        """Return the design as JSON types; long samples are replaced by their SHA-256."""
        return {
            "vary": {path: _written_out(levels) for path, levels in self.factors.items()},
            "samples": {path: _digest(values) for path, values in self.samples.items()},
            "ties": dict(self.ties),
        }


def design_of(
    grid: Mapping[str, Values] | None = None,
    samples: Mapping[str, Values] | None = None,
    ties: Mapping[str, str] | None = None,
) -> Design:
    """Return the design of every combination in `grid`, each with all `samples`.

    Raises:
        SceneError: A value is invalid for its field.
        ValueError: Nothing varies, a field occurs twice, samples differ in length, ties are not paths by path, or a tie
            refers to a path that does not vary.
    """
    _check_ties(ties)
    _refuse_same_field((*(grid or {}), *(samples or {}), *(ties or {})))
    design = Design(
        factors={path: _values_of_path(path, values) for path, values in (grid or {}).items()},
        samples={path: _values_of_path(path, values) for path, values in (samples or {}).items()},
        ties=dict(ties or {}),
    )
    for path, values in design.columns(0, 1).items():
        if values.dtype != object:
            _check_takes_numbers(path, design.ties.get(path))
    return design


def counts_of(
    grid: Mapping[str, Values] | None, samples: Mapping[str, Values] | None
) -> tuple[dict[str, int], int | None]:
    """Return the number of values per path and the length of the longest samples, for `check_rows`."""
    lengths = [len(values) for values in (samples or {}).values()]
    return {path: len(values) for path, values in (grid or {}).items()}, max(lengths, default=None)


def _check_ties(ties: Mapping[str, str] | None) -> None:
    """Refuse ties that are not paths by path.

    Raises:
        ValueError: Gives the form.
    """
    if ties is None:
        return
    if not isinstance(ties, Mapping) or not all(isinstance(path, str) for tie in ties.items() for path in tie):
        message = f'ties = {ties!r}: must be paths by path, such as {{"link.backward.delay_s": "link.forward.delay_s"}}'
        raise ValueError(message)


def _check_takes_numbers(path: str, leading: str | None) -> None:
    """Refuse numbers for a field that takes none, including numbers of the path that it is tied to.

    Raises:
        SceneError: Gives the types that the field takes.
    """
    steps = path_of(path)
    if takes_numbers(steps):
        return
    of = path if leading is None else f"{path} is tied to {leading}"
    for within, name in ((steps, path), ((*steps, 0), f"{path}.0")):
        if keys := sorted(keys_at(within)):
            kind = "a table" if within == steps else "a list of tables"
            message = f"{of}: is {kind}, no number: name a key of it, {name}.KEY: there is {', '.join(keys)}"
            raise SceneError(message)
    message = f"{of}: takes no numbers, must be {allowed_at(steps)}"
    raise SceneError(message)


def _refuse_same_field(paths: Iterable[str]) -> None:
    """Refuse two paths of the same field: "-" may replace "_".

    Raises:
        SceneError: A path is not in the schema.
        ValueError: Names both paths.
    """
    seen: dict[Path, str] = {}
    for path in paths:
        if path == SCENE:
            continue
        if (other := seen.setdefault(path_of(path), path)) != path:
            message = f"{path}: is the same field as {other}"
            raise ValueError(message)


def _values_of_path(path: str, values: Values) -> npt.NDArray[Any]:
    """Return the values of a parameter: numbers, or objects if not all are numbers.

    Raises:
        SceneError: No field takes such a value.
    """
    # An array of a numeric type needs no check of each value.
    if not (type(values) is np.ndarray and values.dtype.kind in "fiu" and values.ndim == 1):
        values = _without_numpy(values if isinstance(values, np.ndarray) else list(values))
        if any(isinstance(value, bool | str | list | Mapping | SceneChoice) for value in values):
            return _categories(path, values)
        if None in values:
            message = f"{path} = nothing: must be {ALLOWED}"
            raise SceneError(message)
    try:
        numbers = np.array(values, dtype=np.float64)
    except OverflowError:
        message = f"{path}: a number beyond {sys.float_info.max:.2g}: must be numbers that float64 holds"
        raise SceneError(message) from None
    except (TypeError, ValueError):
        message = f"{path}: holds what is none of {ALLOWED}"
        raise SceneError(message) from None
    if numbers.ndim != 1 or numbers.size == 0:
        message = f"{path}: values of shape {numbers.shape}: must be a list of at least one number"
        raise SceneError(message)
    if not np.isfinite(numbers).all():
        message = f"{path} = {numbers[~np.isfinite(numbers)][0]}: must be a finite number"
        raise SceneError(message)
    if path != SCENE and counts_on(path_of(path)) and (large := np.flatnonzero(numbers > LARGEST_EXACT)).size:
        # Check here, before the value is rounded to float64.
        message = f"{path} = {shown(_without_numpy(values[large[0]]))}: must be {EXACT}"
        raise SceneError(message)
    return numbers


def _without_numpy(value: Any) -> Any:  # noqa: ANN401  # whatever a field takes
    """Convert NumPy values and tuples to Python numbers, texts and lists, including nested ones."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return _without_numpy(value.tolist())
    if isinstance(value, list | tuple):
        return [_without_numpy(item) for item in value]
    if isinstance(value, Mapping):
        return {_without_numpy(key): _without_numpy(item) for key, item in value.items()}
    return value


def _categories(path: str, values: Values) -> npt.NDArray[Any]:
    column = np.empty(len(values), dtype=object)
    for row, value in enumerate(values):
        _check_encodable(path, value)
        column[row] = value
    return column


def _check_encodable(path: str, value: object) -> None:
    """Refuse a value that no file can hold.

    Raises:
        SceneError: Gives the value and the error.
    """
    if isinstance(value, SceneChoice):
        return
    try:
        msgspec.msgpack.encode(value, enc_hook=_refuse_type)
    except OverflowError:
        message = f"{path} = {shown(value)}: holds a whole number beyond 64 bits"
        raise SceneError(message) from None
    except UnicodeEncodeError:
        message = f"{path} = {value!a}: holds text that UTF-8 cannot write"
        raise SceneError(message) from None
    except TypeError as error:
        message = f"{path} = {shown(value)}: {error}"
        raise SceneError(message) from None


def _refuse_type(value: object) -> None:
    message = f"holds a {type(value).__qualname__}: must be {ALLOWED}"
    raise TypeError(message)


MOST_WRITTEN_OUT = 64
"""Largest number of samples per path that is written out; longer ones are stored as a digest."""


def _digest(values: npt.NDArray[Any]) -> dict[str, Any]:
    if values.dtype == object or len(values) <= MOST_WRITTEN_OUT:
        return {"values": _written_out(values)}
    return {"count": len(values), "sha256": hashlib.sha256(np.asarray(values, dtype="<f8").tobytes()).hexdigest()}


def _written_out(values: npt.NDArray[Any]) -> list[Any]:
    """Convert to JSON types; scenes by name."""
    return [value.name if isinstance(value, SceneChoice) else value for value in values.tolist()]
