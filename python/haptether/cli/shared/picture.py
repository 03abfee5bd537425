"""What a command that draws is asked about its pictures, and where they go."""

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
    """Of pictures; by default what their path ends in, or png."""
    columns: Literal[1, 2] | None = None
    """How wide pictures are, in columns of a page: 3.5 or 7.16 inches; by default 2."""

    @property
    def page_columns(self) -> Literal[1, 2]:
        """As `columns`, with the default."""
        return self.columns or 2


def picture_file(path: Path, form: "PictureFormat | None", *, force: bool) -> Path:
    """Where a picture goes, refused early: its path ends in what it is, or gets that ending.

    Raises:
        ValueError: An ending that is no picture's, or another than `form`.
        OSError: It cannot be written; a symbolic link; a file that is there, without `force`.
        ImportError: matplotlib is not there.
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
    """Refuse options of pictures where `--plot` asks for none.

    Raises:
        ValueError: With the option.
    """
    if plot is not None:
        return
    for option, value in (("--format", options.format), ("--columns", options.columns)):
        if value is not None:
            message = f"{option} {value}: no picture is asked for: give --plot, too"
            raise ValueError(message)


def asked_picture(plot: Path | None, options: PictureOptions) -> Path | None:
    """As `picture_file`, of a command that draws one where `--plot` asks for it; none where it does not.

    Raises:
        ValueError: As `picture_file`; an option of no picture.
        OSError, ImportError: As `picture_file`.
    """
    check_picture_options(plot, options)
    return None if plot is None else picture_file(plot, options.format, force=options.force)


def picture_in(place: Path, name: str, form: "PictureFormat | None", *, force: bool) -> Path:
    """Where the one picture of a command goes: into a folder, under a name, or to a path that ends in what it is.

    Raises:
        ValueError: An ending that is no picture's, or other than `form`.
        OSError: It cannot be written, or the folder not be made; a symbolic link.
        ImportError: matplotlib is not there.
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
