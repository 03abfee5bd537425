"""Options of a command that draws, and the paths of its pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from haptether.cli.shared.output import FileOptions, check_target, make_folder, require_matplotlib

if TYPE_CHECKING:
    from haptether.view.style.figure import PictureFormat


@dataclass(frozen=True, kw_only=True)
class PictureOptions(FileOptions):
    """Options of a command that draws."""

    format: Literal["png", "pdf", "svg"] | None = None
    """Format of pictures; by default the suffix of their path, or png."""
    columns: Literal[1, 2] | None = None
    """Width of pictures in columns of a page: 3.5 or 7.16 inches; by default 2."""
    style: Literal["screen", "paper"] | None = None
    """Style of pictures: for a screen with a title; for a paper in letters of Times without a title, its PNG with 600
    dots an inch. By default screen."""

    @property
    def page_columns(self) -> Literal[1, 2]:
        """Width of pictures as `columns`, with the default."""
        return self.columns or 2


def picture_file(path: Path, form: "PictureFormat | None", *, force: bool) -> Path:
    """Return the path of a picture, refused early; it gets the suffix of its format if it has none.

    Raises:
        ValueError: A suffix that is not a picture's, or another than `form`.
        OSError: It cannot be written; a symbolic link; an existing file, without `force`.
        ImportError: matplotlib is not installed.
    """
    from haptether.view.style.figure import FORMATS

    require_matplotlib()
    ending = path.suffix[1:].lower()
    if ending not in FORMATS:
        if form is None or path.suffix:
            message = f"{path}: must end in {', '.join(f'.{name}' for name in FORMATS)}"
            raise ValueError(message)
        path = path.with_suffix(f".{form}")
    elif form is not None and ending != form:
        message = f"{path}, format = {form}: the two differ: give one of them, or both alike"
        raise ValueError(message)
    check_target(path, force=force)
    return path


def check_picture_options(plot: Path | None, options: PictureOptions) -> None:
    """Refuse options of pictures if `--plot` requests none.

    Raises:
        ValueError: An option of a picture without `--plot`; the message names it.
    """
    if plot is not None:
        return
    for option, value in (("--format", options.format), ("--columns", options.columns), ("--style", options.style)):
        if value is not None:
            message = f"{option} {value}: no picture is asked for: give --plot, too"
            raise ValueError(message)


def asked_picture(plot: Path | None, options: PictureOptions) -> Path | None:
    """Return `picture_file` of the path that `--plot` requests; None without a request.

    Raises:
        ValueError: As `picture_file`, or an option of a picture without one.
        OSError, ImportError: As `picture_file`.
    """
    check_picture_options(plot, options)
    return None if plot is None else picture_file(plot, options.format, force=options.force)


def picture_in(place: Path, name: str, form: "PictureFormat | None", *, force: bool) -> Path:
    """Return the path of a command's one picture: in a folder under `name`, or a path with the suffix of its format.

    Raises:
        ValueError: A suffix that is not a picture's, or other than `form`.
        OSError: It cannot be written, or the folder cannot be made; a symbolic link.
        ImportError: matplotlib is not installed.
    """
    from haptether.view.style.figure import FORMATS

    if place.suffix[1:].lower() in FORMATS and not place.is_dir():
        return picture_file(place, form, force=force)
    if place.suffix and not place.exists():
        message = f"{place}: must be a folder, or end in {', '.join(f'.{name}' for name in FORMATS)}"
        raise ValueError(message)
    require_matplotlib()
    make_folder(place)
    return picture_file(place / f"{name}.{form or 'png'}", form, force=force)
