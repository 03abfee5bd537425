"""`haptether view`."""

import re
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.shared.output import FileOptions
from haptether.cli.view.connecting import WaitOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from haptether.bridge import Run, Scene
    from haptether.cli.shared.screen import Screen
    from haptether.view import Description
    from haptether.view.following import Following

MAX_FRAMES = 20_000
RECORDINGS = (".mcap", ".npz")
MOST_SIDES = 2
MAX_LIVE_S = 86_400.0
ROUNDING_S = 1e-9
MAX_HISTORY_S, LIVE_HISTORY_S = 120.0, 20.0
"""History of a live run in s: for files, and in a window."""
LIVE_PICTURE_S, LIVE_FILM_S = 1.0, 5.0
"""Time in s for which a live run is followed by default."""


@dataclass(frozen=True, kw_only=True)
class View(WaitOptions, FileOptions):
    """Show a run in three dimensions: hand and robot, what they touch, forces, trails, observers and a time line.

    WHAT is the name of a scene that comes with Haptether, or the path of a TOML file, which are run first. It may also
    be the recording (.mcap) of one side, or those of both, or a file of `Run.save` (.npz). --connect shows a run in
    progress, which the view only reads. Without --screenshot, --movie or --html it opens a window, whose keys `?`
    lists; those three need no display. Exit status 2: the request cannot be met, for example without OpenGL; 1, of a
    live run: a side has failed or was killed.

    Examples:

    haptether view remote_push

    haptether view ur_pick --camera corner --at-s 4 --screenshot ur_pick.png

    haptether view remote_push --compare safety.controllers=[] --from-s 2 --speed 0.25 --movie push.gif

    haptether view peg_in_hole --html peg.html

    haptether view master.mcap slave.mcap

    haptether view --connect /tmp/master.sock --connect /tmp/slave.sock
    """

    what: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[RUN [RUN]|SCENE]")] = ()
    """Name of a shipped scene, path of a TOML file, or paths of recordings, one of each side."""
    connect: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="PATH")] = ()
    """Show a run in progress: the socket of --telemetry of master or slave; once for each side. Without it and a RUN,
    the sides that run here. Pictures, films and pages are made once the run has come to --at-s and --until-s."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Scene of a recording that does not name its own."""
    arm: Annotated[str, tyro.conf.arg(metavar="ARM")] = ""
    """Arm that is drawn at the robot, which recordings and telemetry do not name: ur3e, ur5e, ..., or a description of
    servos by its name or path."""
    leader: Annotated[str, tyro.conf.arg(metavar="ARM")] = ""
    """Arm of servos that is drawn at the hand."""
    slave_begun_s: float | None = None
    """Time in s from the beginning of the master's recording to that of the slave's; by default by their clocks."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="TABLE.KEY=VALUE"),
    ] = ()
    """Change a field of the scene; may be given often."""
    compare: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="TABLE.KEY=VALUE"),
    ] = ()
    """Run the scene once more with this field changed, and show both side by side; may be given often, for one more run
    with all of the changes."""
    title: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TEXT")] = ()
    """Title above a run instead of its name; once for each."""
    at_s: float | None = None
    """Time in s of the screenshot, or at which the window begins; by default the middle of a run, of a live run after 1
    s."""
    screenshot: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png")] = None
    """Write a picture."""
    movie: Annotated[Path | None, tyro.conf.arg(metavar="FILE.gif|FILE.mp4")] = None
    """Write a film; .mp4 needs ffmpeg."""
    html: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Write a page that plays and turns by itself, without a network."""
    from_s: float | None = None
    """Beginning of a film or a page in s; by default that of the run."""
    until_s: float | None = None
    """End of a film or a page in s; by default that of the run, of a live run after 5 s."""
    speed: float = 1.0
    """Speed of a film: 0.25 takes four times as long as the run did."""
    fps: float = 25.0
    """Frames a second of a film or a page, 1 to 60."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "1280x720"
    """Width and height in pixels."""
    camera: Literal["front", "side", "top", "corner"] = "front"
    """Direction of view."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write as JSON what is shown and what is not; - for standard output."""

    def run(self) -> int:
        """Show the run, or write it."""
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.cli.shared.screen import screen
        from haptether.view.film import require_film
        from haptether.view.picture.gl import require_gl

        if not self.what and not self.connect:
            from haptether.cli.view.connecting import sides_here

            if sides := sides_here():
                return replace(self, connect=sides).run()
        self._check_what()
        size = size_of(self.size)
        if len(self.title) > (most := 1 + bool(self.compare)):
            message = f"--title: given {len(self.title)} times, must be once for each of {most}"
            raise ValueError(message)
        self._check_numbers()
        files = {"screenshot": self.screenshot, "movie": self.movie, "html": self.html, "json": self.json}
        check_distinct(**files)
        check_target(*files.values(), force=self.force)
        self._check_endings()
        if self.movie is not None:
            require_film(self.movie)
        if self.screenshot is not None or self.movie is not None or not self._writes:
            require_gl(window=not self._writes)
        console = screen(self.json)
        if self.connect and not self._writes:
            return self._show_live(size, console)
        described = self._followed(console) if self.connect else self._described(console)
        self._check_times(described)
        for note in dict.fromkeys(note for one in described for note in one.notes):
            console.print(f"note: {note}")
        if not self._writes:
            self._show(described, size)
        if self.screenshot is not None or self.movie is not None:
            self._draw(described, size)
        if self.html is not None:
            self._write_page(described)
        for name, path in files.items():
            if path is not None and name != "json":
                console.print(f"{name}: {path}")
        self._report(described)
        return 0

    @property
    def _writes(self) -> bool:
        return any(path is not None for path in (self.screenshot, self.movie, self.html))

    def _check_endings(self) -> None:
        for path, ending in ((self.screenshot, ".png"), (self.html, ".html")):
            if path is not None and path.suffix != ending:
                message = f"{path}: must end in {ending}"
                raise ValueError(message)

    def _check_numbers(self) -> None:
        if not 1.0 <= self.fps <= 60.0:
            message = f"--fps {self.fps:g}: must be 1 to 60"
            raise ValueError(message)
        if not 1e-3 <= self.speed <= 100.0:
            message = f"--speed {self.speed:g}: must be 0.001 to 100"
            raise ValueError(message)

    def _described(self, console: "Screen") -> "list[Description]":
        """Return a description of each run."""
        from haptether.bridge import load_scene
        from haptether.cli.scene.simulate import spinner
        from haptether.view import describe_beside

        (what, *others) = self.what
        arms = {"arm": self.arm, "leader": self.leader}
        if what.endswith(RECORDINGS):
            scene = None if self.scene is None else load_scene(self.scene)
            with spinner(f"reading {' and '.join(self.what)}"):
                run = recorded(Path(what), *map(Path, others), slave_begun_s=self.slave_begun_s)
                return describe_beside([(run, scene, "".join(self.title[:1]))], **arms)
        with spinner(f"running {what}"):
            runs = [simulated(what, self.set, console)]
            titles = [""]
            if self.compare:
                runs.append(simulated(what, (*self.set, *self.compare), console))
                titles = [", ".join(self.set) or "as the scene says", ", ".join(self.compare)]
            titles = [*self.title, *titles[len(self.title) :]]
            of = [(run, scene, title) for (run, scene), title in zip(runs, titles, strict=True)]
            return describe_beside(of, **arms)

    @contextmanager
    def _following(self, history_s: float) -> "Iterator[Following]":
        from contextlib import ExitStack

        from haptether.cli.view.connecting import connected
        from haptether.view.following import Following

        with ExitStack() as stack:
            readers = [(path, stack.enter_context(connected(path, self.wait_s))) for path in self.connect]
            following = Following(
                readers, title="".join(self.title), arm=self.arm, leader=self.leader, history_s=history_s
            )
            yield stack.enter_context(following)

    def _followed(self, console: "Screen") -> "list[Description]":
        """Return the history of a live run once it has come to the end of the last file."""
        wanted = [time_s for time_s in (self.at_s, self.from_s, self.until_s) if time_s is not None]
        if any(not 0.0 <= time_s <= MAX_LIVE_S for time_s in wanted):
            message = f"--at-s, --from-s, --until-s of a live run: must be 0 to {MAX_LIVE_S:g} s"
            raise ValueError(message)
        with self._following(MAX_HISTORY_S) as following:
            begin_s = following.begin()
            lasts = self.movie is not None or self.html is not None
            end_s = max(wanted, default=0.0)
            if self.at_s is None and self.screenshot is not None:
                end_s = max(end_s, begin_s + LIVE_PICTURE_S)
            if self.until_s is None and lasts:
                end_s = max(end_s, begin_s + LIVE_FILM_S)
            console.print(f"following to {end_s:.1f} s of the run")
            following.until(end_s)
            following.check()
            if following.is_over and following.live.time_s < end_s:
                console.print(f"note: the run ended at {following.live.time_s:.3f} s")
            return [following.live.refresh()]

    def _show_live(self, size: tuple[int, int], console: "Screen") -> int:
        from haptether.view.window.live import LiveWindow

        with self._following(LIVE_HISTORY_S) as following:
            following.begin()
            for note in following.live.description.notes:
                console.print(f"note: {note}")
            window = LiveWindow(following, size=size, camera=self.camera)
            window.show()
            following.check()
            self._report([following.live.refresh()])
        return 0

    def _check_what(self) -> None:
        """Refuse invalid runs before a display is looked for."""
        from haptether.bridge import SceneError, load_scene
        from haptether.cli.recording.files import check_files

        if self.wait_s and not self.connect:
            message = f"--wait-s {self.wait_s:g}: give --connect, which side is waited for"
            raise ValueError(message)
        if self.connect:
            given = {"a run or scene": self.what, "--set": self.set, "--compare": self.compare, "--scene": self.scene}
            if found := [name for name, value in given.items() if value]:
                message = f"--connect and {found[0]}: must be one of the two"
                raise ValueError(message)
            if len(self.connect) > MOST_SIDES:
                message = f"--connect: given {len(self.connect)} times, must be once for each side"
                raise ValueError(message)
            return
        if not self.what:
            message = (
                "which run? Name a scene of `haptether simulate --list`, a TOML file, a recording (.mcap, .npz), or "
                "--connect to one that goes on"
            )
            raise SceneError(message)
        are_recordings = self.what[0].endswith(RECORDINGS)
        most = 2 if self.what[0].endswith(".mcap") else 1
        if len(self.what) > most or any(not one.endswith(".mcap") for one in self.what[1:]):
            message = f"{' '.join(self.what)}: must be one scene, one .npz, or the .mcap of one side or of each"
            raise ValueError(message)
        if are_recordings and (self.set or self.compare):
            message = f"{self.what[0]}: --set and --compare change scenes, not recordings"
            raise ValueError(message)
        if not are_recordings and (self.scene or self.slave_begun_s is not None):
            message = f"{self.what[0]}: --scene and --slave-begun-s are of recordings"
            raise ValueError(message)
        if are_recordings:
            check_files(*map(Path, self.what), what="a recording (.mcap), or what Run.save wrote (.npz)")
        else:
            load_scene(self.what[0], self.set)

    def _check_times(self, described: "list[Description]") -> None:
        begin_s, end_s = bounds(described)[0], max(one.timeline.over_s for one in described)
        if self.connect:
            # The run may have ended before, or the view may have begun to follow it later.
            begin_s, end_s = 0.0, MAX_LIVE_S
        for option, time_s in (("--at-s", self.at_s), ("--from-s", self.from_s), ("--until-s", self.until_s)):
            if time_s is not None and not begin_s - ROUNDING_S <= time_s <= end_s + ROUNDING_S:
                message = f"{option} {time_s:g}: must be within the run, {begin_s:g} to {end_s:g} s"
                raise ValueError(message)
        begin_s, end_s = self._span(described)
        if begin_s >= end_s and (self.from_s is not None or self.until_s is not None):
            message = f"--from-s {begin_s:g}: must be before --until-s {end_s:g}"
            raise ValueError(message)
        frames = (end_s - begin_s) * self.fps / self.speed
        if (self.movie is not None or self.html is not None) and frames > MAX_FRAMES:
            message = f"{frames:.0f} frames: must be at most {MAX_FRAMES}; give --from-s, --until-s, --fps or --speed"
            raise ValueError(message)

    def _span(self, described: "list[Description]") -> tuple[float, float]:
        begin_s, end_s = bounds(described)
        from_s = begin_s if self.from_s is None else self.from_s
        until_s = end_s if self.until_s is None else self.until_s
        return min(max(from_s, begin_s), end_s), min(max(until_s, begin_s), end_s)

    def _at(self, described: "list[Description]") -> float:
        begin_s, end_s = bounds(described)
        if self.at_s is None:
            return end_s if self.connect else 0.5 * (begin_s + end_s)
        return min(max(self.at_s, begin_s), end_s)

    def _show(self, described: "list[Description]", size: tuple[int, int]) -> None:
        from haptether.view.window.playback import Playback

        Playback(described, size=size, camera=self.camera, at_s=self.at_s).show()

    def _draw(self, described: "list[Description]", size: tuple[int, int]) -> None:
        from haptether.view.film import frame_times, write_film, write_picture
        from haptether.view.picture.picture import Picture

        with Picture(described, size=size, camera=self.camera) as picture:
            if self.screenshot is not None:
                write_picture(self.screenshot, picture.image(self._at(described)))
            if self.movie is not None:
                times_s = frame_times(*self._span(described), self.fps, self.speed)
                with progress(len(times_s)) as done:
                    write_film(self.movie, picture.image, times_s, self.fps, done)

    def _write_page(self, described: "list[Description]") -> None:
        from haptether.view.film import frame_times
        from haptether.view.page.page import write_page

        assert self.html is not None
        times_s = frame_times(*self._span(described), self.fps, 1.0)
        with progress(len(times_s)) as done:
            write_page(self.html, described, times_s, camera=self.camera, progress=done)

    def _report(self, described: "list[Description]") -> None:
        from haptether import __version__
        from haptether.cli.shared.output import write_report

        shown = [*self.what, *map(str, self.connect)]
        rows = [
            {
                "title": one.title,
                "begin_s": one.timeline.begin_s,
                "end_s": one.timeline.end_s,
                "parts": [part.name for part in one.parts],
                "metres_per_newton": {arrow.name: arrow.scale for arrow in one.arrows},
                "events": [{"time_s": mark.time_s, "kind": mark.kind} for mark in one.timeline.marks],
                "trips": one.timeline.trips,
                "notes": one.notes,
            }
            for one in described
        ]
        write_report(self.json, {"version": __version__, "shown": shown, "runs": rows})


def size_of(text: str) -> tuple[int, int]:
    """Return width and height in pixels of `WxH`.

    Raises:
        ValueError: Another form, or a size that cannot be drawn.
    """
    from haptether.view.picture.layout import LARGEST_SIZE, LEAST_SIZE

    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(low <= pixels <= high for low, pixels, high in zip(LEAST_SIZE, size, LARGEST_SIZE, strict=True)):
        least, largest = ("x".join(map(str, of)) for of in (LEAST_SIZE, LARGEST_SIZE))
        message = f"--size {text[:20]}: must be WxH in pixels, {least} to {largest}"
        raise ValueError(message)
    return size


def simulated(what: str, overrides: tuple[str, ...], console: "Screen") -> "tuple[Run, Scene]":
    """Run a scene, with its signals kept even if it keeps none; return the run and the scene."""
    from haptether.bridge import load_scene, simulate
    from haptether.cli.shared.unusual import ask_units

    scene = load_scene(what, overrides)
    ask_units(console, [scene])
    kept = overrides if scene.record is not None else (*overrides, "record.every=1")
    return simulate(what, overrides=kept), scene


def recorded(path: Path, *other: Path, slave_begun_s: float | None = None) -> "Run":
    """Return a recording of one side or of both, or a run of `Run.save`.

    Raises:
        OSError: It cannot be read.
        ValueError: It is not a recording, or the two do not go together.
    """
    from haptether.bridge import load
    from haptether.view.saved import saved_run

    if path.suffix == ".npz":
        return saved_run(path)
    return load(path, *other, slave_begun_s=slave_begun_s)


def bounds(described: "list[Description]") -> tuple[float, float]:
    """Return when the first of them begins and the last ends, in s."""
    return min(one.timeline.begin_s for one in described), max(one.timeline.end_s for one in described)


@contextmanager
def progress(frames: int) -> "Iterator[Callable[[int], None]]":
    """Show on standard error how many frames are done."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    from haptether.cli.shared.screen import Screen

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Screen(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=frames)
        yield lambda done: bar.update(task, completed=done)
