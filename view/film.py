"""Films: GIF by Pillow, MP4 by the user's ffmpeg."""

import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from haptether.private_file import private_file, refuse_link
from haptether.view.scene3d import colours

Pixels = npt.NDArray[np.uint8]

COLOURS = 96
"""Colours of a GIF taken from its frames; rare sign colours are added."""
SHADES = (1.0, 0.8, 0.6)
"""Shades of the sign colours."""
PALETTE_FRAMES = 8
"""Frames from which the colours are taken."""
LAST_S = 1.0
"""Time for which the last frame of a looping GIF stays."""


def frame_times(begin_s: float, end_s: float, fps: float, speed: float) -> list[float]:
    """Times of frames in s, from `begin_s` to `end_s` if that falls on a frame."""
    count = int(np.floor((end_s - begin_s) * fps / speed + 1e-9)) + 1
    return [begin_s + n * speed / fps for n in range(max(1, count))]


def write_picture(path: Path, pixels: Pixels) -> None:
    """Write a PNG with mode 0600.

    Raises:
        OSError: The file cannot be written, or is a symbolic link.
    """
    from PIL import Image

    refuse_link(path)
    with private_file(path) as file:
        Image.fromarray(pixels).save(file, format="PNG", compress_level=6)


def require_film(path: Path) -> None:
    """Check that a film can be made.

    Raises:
        ValueError: The ending is neither .gif nor .mp4, or ffmpeg is missing for .mp4.
    """
    if path.suffix not in {".gif", ".mp4"}:
        message = f"{path}: must end in .gif or .mp4"
        raise ValueError(message)
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        message = f"{path}: MP4 needs ffmpeg on PATH (Debian or Ubuntu: ffmpeg); a .gif needs nothing"
        raise ValueError(message)


def write_film(
    path: Path, image: Callable[[float], Pixels], times_s: Sequence[float], fps: float, progress: Callable[[int], None]
) -> None:
    """Write a film with mode 0600.

    Args:
        path: Path that ends in .gif or .mp4.
        image: Picture at a time in s, (height, width, 3).
        times_s: Times of the frames.
        fps: Frames per second.
        progress: Called with the number of finished frames.

    Raises:
        OSError: The file cannot be written, or is a symbolic link.
        RuntimeError: ffmpeg fails.
        ValueError: The ending is invalid, or ffmpeg is missing.
    """
    require_film(path)
    refuse_link(path)

    def frames() -> Iterator[Pixels]:
        for number, time_s in enumerate(times_s, start=1):
            yield image(time_s)
            progress(number)

    if path.suffix == ".gif":
        _write_gif(path, image, times_s, fps, frames())
    else:
        _write_mp4(path, frames(), fps)


def _write_gif(
    path: Path, image: Callable[[float], Pixels], times_s: Sequence[float], fps: float, frames: Iterable[Pixels]
) -> None:
    from PIL import Image

    # A common palette without dithering keeps static areas identical between frames, so that they cost no space.
    some = [image(times_s[n]) for n in np.unique(np.linspace(0, len(times_s) - 1, PALETTE_FRAMES).astype(int))]
    frequent = Image.fromarray(np.concatenate(some)).quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
    rgb = [int(colour[at : at + 2], 16) for colour in colours.SIGNS for at in (1, 3, 5)]
    signs = [round(shade * level) for shade in SHADES for level in rgb]
    palette = Image.new("P", (1, 1))
    palette.putpalette([*(frequent.getpalette() or [])[: 3 * COLOURS], *signs])
    # Pass frames one by one: the file stores only differences between frames.
    flat = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    each_ms = round(1000.0 / fps)
    durations = [each_ms] * (len(times_s) - 1) + [each_ms + round(1000.0 * LAST_S)]
    first = next(flat)
    with private_file(path) as file:
        first.save(file, format="GIF", save_all=True, append_images=flat, duration=durations, loop=0, optimize=False)


def _write_mp4(path: Path, frames: Iterator[Pixels], fps: float) -> None:
    first = next(frames)
    height, width, _ = first.shape
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "film.mp4"
        command = [
            "ffmpeg", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24",
            "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-",
            "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(made),
        ]  # fmt: skip
        encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
        assert encoder.stdin is not None
        try:
            for frame in chain([first], frames):
                encoder.stdin.write(np.ascontiguousarray(frame).tobytes())
        except BrokenPipeError:
            # ffmpeg's error text is raised below.
            pass
        finally:
            _, said = encoder.communicate()
        if encoder.returncode != 0:
            message = f"{path}: ffmpeg: {said.decode(errors='replace').strip() or encoder.returncode}"
            raise RuntimeError(message)
        with private_file(path) as file, made.open("rb") as film:
            shutil.copyfileobj(film, file)
